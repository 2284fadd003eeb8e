"""`jaxbelt verify`: checks a store."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

import jaxbelt as jb

from .options import Json, plain_errors, say, turn_on_float64


def verify(
    store: Annotated[Path, typer.Argument(help="A store that sweep wrote, such as plane.zarr.")],
    repair: Annotated[
        bool, typer.Option("--repair", help="Mark bad blocks, so that the sweep does them again.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Compute the checksums of a store again and show which of its blocks and axes are right.

    Exit code 1 if there are bad blocks or axes and they are not repaired. After a repair the
    command or the call that made the store does the marked blocks again, and writes bad axes again.

    Example: **jaxbelt verify plane.zarr --repair**
    """
    with plain_errors():
        if not store.is_dir():
            raise ValueError(f"store must be a folder that sweep wrote, got {store}")
        turn_on_float64()
        found = jb.verify(store, repair)
    say([repr(found)], as_json=as_json, data=asdict(found))
    if (found.bad or found.axes) and not repair:
        raise typer.Exit(1)
