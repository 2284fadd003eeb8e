"""`jaxbelt cache`: compiled programs on disk."""

from typing import Annotated, Any

import typer

from .options import Json, plain_errors, say


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
    with plain_errors():
        # Imported late, because JAX comes with it, to keep `--help` quick.
        from ..numerics import programs

        removed = programs.clear() if clear else 0
        words, data = what_is_kept()
    lines = [f"{removed} programs removed"] * clear + [words]
    say(lines, as_json=as_json, data=data | {"removed": removed})


def what_is_kept() -> tuple[str, dict[str, Any]]:
    """The folder of compiled programs, their number and size, in words and as data."""
    from ..numerics import programs

    folder, found = programs.folder(), programs.entries()
    size = sum(one.size for one in found)
    words = f"{len(found)} programs, {size / 2**20:.1f} MiB, in {folder}"
    if folder is None:
        words = "nothing is kept: it is switched off, or the folder cannot be used"
    return words, dict(folder=folder and str(folder), programs=len(found), bytes=size)
