"""The README is the first page; the notebooks are pages from where they lie."""

from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]


def on_files(files, config):
    """Adds them to what mkdocs found in docs/."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    # What is not a page is reached where the project lies.
    readme = readme.replace("](CITATION.cff)", "](files/CITATION.cff)").replace("](docs/", "](")
    files.append(File.generated(config, "index.md", content=readme))
    files.append(File.generated(config, "files/CITATION.cff", abs_src_path=ROOT / "CITATION.cff"))
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{notebook.name}", abs_src_path=notebook))
    return files
