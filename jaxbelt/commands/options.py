"""What the commands share: checks of their options, errors in one sentence, what they print.

This module and the commands import JAX and the numerical modules only when they compute. So help
and messages about wrong options appear at once.
"""

import json
import math
import os
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ..interrupts import heard_interrupts
from ..spelling import did_you_mean


@contextmanager
def plain_errors() -> Iterator[None]:
    """Prints a user's error in one sentence, without a traceback, and exits with code 2.

    An interrupt exits with code 130, as in shells.
    """
    try:
        with _interrupts_that_count(), heard_interrupts(at_once=True):
            yield
    except KeyboardInterrupt as error:
        typer.secho(str(error) or "interrupted", err=True, fg=typer.colors.RED)
        # At once: an exit by an exception would wait for a compilation under way.
        sys.stdout.flush()
        os._exit(130)
    except (ValueError, OSError) as error:
        typer.secho(f"Error: {error}", err=True, fg=typer.colors.RED)
        raise typer.Exit(2) from None


#: Seconds that a computation has after an interrupt to end and to report on its runs.
GRACE = 2.0


@contextmanager
def _interrupts_that_count() -> Iterator[None]:
    """Ends the process after an interrupt that Python does not notice.

    Python does not notice it while the main thread compiles.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # no signals arrive in other threads
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)

    def watch() -> None:
        while number := reader.recv(1):
            if number[0] == signal.SIGINT:
                time.sleep(GRACE)
                print("interrupted", file=sys.stderr, flush=True)
                os._exit(130)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        writer.close()  # ends the watching thread
        watcher.join(GRACE / 10)
        reader.close()


def turn_on_float64() -> None:
    """Turns 64-bit floats on, before a command computes.

    The package itself never touches JAX's settings; a program may.
    """
    import jax

    jax.config.update("jax_enable_x64", True)


def outputs(out: Path, *ends: str) -> list[Path]:
    """Paths of the files that `out` stands for; raises, before anything is computed, if one
    cannot be written."""
    if not out.name:
        raise ValueError(f"out must be the beginning of files' names, got {str(out)!r}")
    paths = [out.with_name(out.name + end) for end in ends]
    for path in paths:
        check_out(path)
    return paths


def check_out(out: Path) -> None:
    """Raises unless a file can be written there; missing folders are made later."""
    if out.is_dir():
        raise IsADirectoryError(f"out must be a file, got the folder {out}")
    there = next(folder for folder in out.absolute().parents if folder.exists())
    try:
        if out.exists() and not os.access(out, os.W_OK):
            raise PermissionError
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError:
        raise OSError(f"out must be a place that can be written to, got {out}") from None


#: Bytes that a run or a sample takes until its results are written (measured: 300).
BYTES_OF_RUN = 400
#: The same for a cell of a map (measured: 2,000), and a row of a diagram (measured: 18,000).
BYTES_OF_CELL, BYTES_OF_ROW = 2_000, 20_000


def check_count(
    name: str, value: int, least: int = 1, *, each: int = BYTES_OF_RUN, sides: int = 1
) -> None:
    """Raises unless an integer is as large as that, or larger, and the machine has memory for the
    results.

    each: bytes of one result; sides: 2 where the results are a square of that side.
    """
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value}")
    if value**sides * each > (memory := _memory()):
        most = math.floor((memory / each) ** (1 / sides))
        raise ValueError(
            f"{name} must be at most {most}, got {value}: this machine has no memory for more "
            f"results ({memory / 2**30:.3g} GiB, {each} bytes each)"
        )


def _memory() -> int:
    """Bytes of memory of this machine; 16 GiB where the system does not tell."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return 2**34


def check_word(name: str, word: str, known: Collection[str]) -> None:
    """Raises unless a word is one of `known`; the message suggests a similar one."""
    if word not in known:
        meant = did_you_mean(word, known)
        raise ValueError(f"{name} must be one of {', '.join(known)}, got {word}{meant}")


def check_number(name: str, value: float) -> None:
    """Raises unless a number is finite and > 0; so does the package, but only once it is
    imported."""
    if not 0 < value < math.inf:
        raise ValueError(f"{name} must be finite and > 0, got {value}")


#: Largest tolerance of a step; with larger ones the result is no motion of the oscillator.
LOOSEST = 1e-2


def tolerances(value: float | None) -> dict[str, float]:
    """Arguments rtol and atol for the value of `--tolerance`; empty for None.

    Raises:
        ValueError: If the tolerance is not positive or larger than LOOSEST.
    """
    if value is None:
        return {}
    if not 0 < value <= LOOSEST:
        raise ValueError(f"tolerance must be > 0 and at most {LOOSEST}, got {value}")
    return {"rtol": value, "atol": value}


def check_range(name: str, ends: tuple[float, float]) -> None:
    """Raises unless an option FROM TO is an interval."""
    first, last = ends
    if not -math.inf < first < last < math.inf:
        raise ValueError(f"{name} must be FROM TO with FROM < TO, got {first} {last}")


def make_console() -> Console:
    """A console as wide as the terminal; 200 letters wide where the output is no terminal."""
    console = Console()
    return console if console.is_terminal else Console(width=200)


def steps_bar(console: Console, width: int, hidden: bool) -> Progress:
    """A progress bar for named steps; width: letters of a name. hidden: shows nothing."""
    name = TextColumn(f"{{task.description:<{width}}}")
    columns = name, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    return Progress(*columns, console=console, disable=hidden)


def say(
    lines: Iterable[str], written: Iterable[Path] = (), *, as_json: bool, data: dict[str, Any]
) -> None:
    """Prints lines and the paths of written files; as_json: `data` and these paths as JSON."""
    if as_json:
        print(json.dumps({**data, "written": [str(path) for path in written]}))
        return
    console, files = make_console(), ", ".join(map(str, written))
    for line in (*lines, *([f"Written: {files}"] if files else [])):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def picture(path: Path, width: float, height: float) -> Iterator[Any]:
    """An empty figure in journal style, size in inches; saved to `path` when the context ends."""
    from ..plotting.style import journal_figure, journal_style, save

    with journal_style():
        figure = journal_figure(width, height)
        yield figure
        path.parent.mkdir(parents=True, exist_ok=True)
        save(figure, path)


def as_json_value(value: Any) -> Any:
    """A number or an array as JSON; numbers that are not finite are null."""
    import numpy as np

    def one(x: Any) -> Any:
        return [one(part) for part in x] if isinstance(x, list) else x if np.isfinite(x) else None

    return one(np.asarray(value).tolist())


def option(text: str, default: str) -> Any:
    """Option with this help, and words for its default."""
    return typer.Option(help=text, show_default=default)


Json = Annotated[
    bool, typer.Option("--json", help="Print the results as one line of JSON, for scripts.")
]
Interval = tuple[float, float]
Start = Annotated[
    Interval | None,
    typer.Option(
        metavar="X1 X2",
        help="Displacement x1 and velocity x2 at tau = 0; of a machine in m and m/s.",
        show_default="3.0 0.0, dimensionless",
    ),
]
Out = Annotated[
    Path,
    typer.Option(
        help="Where to write, without an ending: OUT.png, OUT.csv, ... Folders that are missing "
        "are made."
    ),
]


def from_to(text: str) -> Any:
    """Option of an interval, FROM TO, with this help."""
    return typer.Option(metavar="FROM TO", help=text)


def tolerance_of(default: str) -> Any:
    """Option of the tolerances of a step; default: the relative one, in words."""
    text = "Relative and absolute tolerance of the integrator; of a machine the latter is in "
    return option(f"{text}max N / k.", f"{default}, the absolute one of the oscillator's own size")


Vary = Annotated[
    str,
    typer.Option(
        "--vary",
        help="The parameter: nu0, nu1, ..., zeta, sigma, sigma0, sigma1, or its path, such as "
        "belts[1].friction.steepness or forcing[0].frequency.",
    ),
]
VarySpan = Annotated[Interval, from_to("Its first and last value; of a machine in its SI unit.")]
