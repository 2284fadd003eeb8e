"""`jaxbelt cache`: compiled programs on disk."""

from typing import Annotated

import typer

from .options import Json, make_console, plain_errors, say


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all of them.")] = False,
    as_json: Json = False,
) -> None:
    """Show where compiled programs are kept, how many there are and how large they are.

    The folder is **programs** in JAXBELT_CACHE_DIR, or else in the user's cache folder; with
    JAXBELT_CACHE=0 nothing is kept. The folder may be removed at any time: missing programs are
    compiled again.

    Example: **jaxbelt cache --clear**
    """
    # Imported late, because JAX comes with it, to keep `--help` quick.
    from ..numerics import programs

    with plain_errors():
        folder = programs.folder()
        removed = programs.clear() if clear else 0
        found = programs.entries()
    size = sum(one.size for one in found)
    lines = [f"{len(found)} programs, {size / 2**20:.1f} MiB, in {folder}"]
    if folder is None:
        lines = ["nothing is kept: it is switched off, or the folder cannot be used"]
    if clear:
        lines.insert(0, f"{removed} programs removed")
    data = dict(folder=folder and str(folder), programs=len(found), bytes=size, removed=removed)
    say(make_console(), lines, [], as_json=as_json, data=data)
