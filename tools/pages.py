"""Checks the built documentation: `python -m tools.pages SITE`.

Every public name has a page with its signature and an example; enumerations list their members;
notebooks and theory have their pictures; no link is dead; nothing comes from the network. These
checks read the HTML. Where chromium is installed, every page is also opened in it, as wide as a
phone and as a desktop screen: every picture has to load, every signature has to be visible, what is
wider than the screen needs its own scroll bar, and no request may leave the site.
"""

import contextlib
import enum
import functools
import http.server
import inspect
import json
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import jaxbelt

ROOT = Path(__file__).parents[1]
#: Widths of a phone and of a desktop screen, in pixels.
WIDTHS = (390, 1280)
#: Seconds that the browser may take for all pages.
PATIENCE = 240.0


class Page(HTMLParser):
    """Contents of a page: ids, links, pictures, sources, signatures, number of examples, text."""

    def __init__(self, path: Path):
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.pictures: list[str] = []
        self.sources: list[str] = []
        self.signatures: set[str] = set()
        self.examples = 0
        self.text = ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        given = {name: value or "" for name, value in attrs}
        classes = given.get("class", "").split()
        if "id" in given:
            self.ids.add(given["id"])
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag == "img":
            self.pictures.append(given["src"])
        if tag == "link" and given.get("rel") in ("stylesheet", "icon", "preload"):
            self.sources.append(given["href"])
        if tag in ("img", "script", "iframe", "source") and "src" in given:
            self.sources.append(given["src"])
        if tag == "dt" and "sig" in classes:
            self.signatures.add(given.get("id", ""))
        self.examples += "highlight-pycon" in classes

    def handle_data(self, data):
        self.text += data


def faults(site: Path) -> list[str]:
    """Faults of the built site that its HTML shows, a line each."""
    pages = {path: Page(path) for path in sorted(site.rglob("*.html"))}
    wrong = [*_public_names(pages), *_pictures(site, pages)]
    for path, page in pages.items():
        name = path.relative_to(site)
        wrong += [f"{name}: from the network: {one}" for one in page.sources if _foreign(one)]
        for link in [*page.links, *page.sources]:
            if not _foreign(link) and not link.startswith(("mailto:", "data:", "#!")):
                wrong += [f"{name}: dead: {link}"] * _dead(pages, path, link)
    return wrong


def _foreign(link: str) -> bool:
    return link.startswith(("http:", "https:", "//"))


def _dead(pages: dict[Path, Page], path: Path, link: str) -> bool:
    parts = urlsplit(link)
    target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
    if target.is_dir():
        target = target / "index.html"
    if parts.fragment and target in pages:
        return unquote(parts.fragment) not in pages[target].ids
    return not target.exists()


def _public_names(pages: dict[Path, Page]) -> list[str]:
    wrong = []
    for name in sorted(set(jaxbelt.__all__) - {"presets"}):
        shown = [page for page in pages.values() if f"jaxbelt.{name}" in page.signatures]
        if len(shown) != 1:
            wrong.append(f"{name}: on {len(shown)} pages")
            continue
        (page,) = shown
        thing = getattr(jaxbelt, name)
        if isinstance(thing, enum.EnumMeta):
            wanted = [member.name for member in thing]
        else:
            wanted = list(inspect.signature(thing).parameters)
        wrong += [f"{name}: no {one}" for one in wanted if one not in page.text]
        wrong += [f"{name}: no example"] * (not page.examples)
    return wrong


def _pictures(site: Path, pages: dict[Path, Page]) -> list[str]:
    stems = [f"notebooks/{path.stem}" for path in (ROOT / "notebooks").glob("*.ipynb")]
    theory = (ROOT / "docs" / "bifurcations").glob("[A-Z]*.md")
    stems += ["index", *(f"bifurcations/{path.stem}" for path in theory)]
    shown = {stem: pages.get(site / f"{stem}.html") for stem in stems}
    return [f"{stem}: no picture" for stem, page in shown.items() if not (page and page.pictures)]


# --- in a browser ---------------------------------------------------------------------------------

PROBE = """<!doctype html><title>probe</title><body><script>
const pages = PAGES, widths = WIDTHS, found = [];
const frame = document.body.appendChild(document.createElement("iframe"));
frame.style.height = "900px";
const load = url => new Promise(done => { frame.onload = done; frame.src = url; });
(async () => {
  for (const width of widths) for (const page of pages) {
    frame.style.width = width + "px";
    await load("/" + page);
    const doc = frame.contentDocument, say = what => found.push(`${page} at ${width}: ${what}`);
    for (const img of doc.images) {
      img.loading = "eager";
      await img.decode().catch(() => say("picture not loaded: " + img.getAttribute("src")));
    }
    for (const sig of doc.querySelectorAll("dt.sig"))
      if (!sig.getClientRects().length) say("signature not seen: " + sig.id);
    const room = doc.documentElement.clientWidth + 1;
    const scrolls = one => /auto|scroll/.test(frame.contentWindow.getComputedStyle(one).overflowX);
    for (const one of doc.querySelectorAll("article *")) {
      if (one.getBoundingClientRect().right <= room) continue;
      let box = one;
      while (box.tagName != "ARTICLE" && !scrolls(box)) box = box.parentElement;
      if (box.tagName == "ARTICLE" || box.getBoundingClientRect().right > room) {
        say("wider than the screen: " + one.outerHTML.slice(0, 100));
        break;
      }
    }
    for (const one of frame.contentWindow.performance.getEntriesByType("resource"))
      if (!one.name.startsWith(location.origin)) say("request to " + one.name);
  }
  await fetch("/probe", { method: "POST", body: JSON.stringify(found) });
})();
</script>"""


def faults_in_browser(site: Path, browser: str) -> list[str]:
    """Faults of the site that a browser finds when it shows the pages, a line each."""
    names = [path.relative_to(site).as_posix() for path in sorted(site.rglob("*.html"))]
    probe = PROBE.replace("PAGES", json.dumps(names)).replace("WIDTHS", json.dumps(WIDTHS))
    told: queue.Queue[list[str]] = queue.Queue()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_GET(self):
            if self.path != "/probe":
                return super().do_GET()
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(probe.encode())

        def do_POST(self):
            told.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, format, *args):
            pass

    handler = functools.partial(Handler, directory=str(site))
    with (
        http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server,
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
    ):
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_address[1]}/probe"
        with _opened(browser, profile, address):
            try:
                return told.get(timeout=PATIENCE)
            except queue.Empty:
                return [f"the browser did not get through within {PATIENCE:g} seconds"]
            finally:
                server.shutdown()


@contextlib.contextmanager
def _opened(browser: str, profile: str, address: str):
    switches = ["headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run"]
    switches += ["disable-background-networking", "disable-component-update", "disable-sync"]
    switches += [f"user-data-dir={profile}", "window-size=1400,1000", "remote-debugging-port=0"]
    command = [browser, *(f"--{switch}" for switch in switches), address]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, **quiet) as process:
        try:
            yield
        finally:
            process.terminate()


def main(folder: str) -> int:
    """Prints all faults of the site in a folder; returns the exit code, 1 if there are any."""
    site = Path(folder).resolve()
    wrong = faults(site)
    browser = shutil.which("chromium")
    if browser:
        wrong += faults_in_browser(site, browser)
    print("\n".join(wrong) or f"the site is whole{' in a browser, too' if browser else ''}")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
