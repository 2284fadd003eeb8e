"""What takes long says what it does, on a terminal or in a notebook, after a second.

Functions that may take long are `announced`; inside of them `tell` says how far they are. Of those
that call one another the outermost one has the line. Elsewhere, in scripts and pipes, nothing is
shown; the logger "jaxbelt" is told in any case: of ends at the level INFO, of the rest at DEBUG.
"""

import functools
import inspect
import logging
import threading
import time
from collections.abc import Callable
from typing import Any, ClassVar

from rich.console import Console
from rich.progress import Progress, ProgressColumn, SpinnerColumn, TextColumn, TimeElapsedColumn

from .spelling import refuse_other_names

#: Seconds before anything is shown that nobody asked for. A busy machine may take another one, and
#: nobody is to see nothing for more than two.
SHOWN_AFTER = 1.0

logger = logging.getLogger("jaxbelt")
logger.addHandler(logging.NullHandler())

_console = Console(stderr=True)
_wanted: bool | None = None


def show_progress(wanted: bool | None = None) -> None:
    """Whether functions that take long show what they do.

    wanted: True, always; False, never; None, on a terminal and in a notebook, which is the default.
    What `sweep` and `basins` are told by `progress` comes first.
    """
    if not (wanted is None or isinstance(wanted, bool)):
        raise ValueError(f"wanted must be True, False or None, got {wanted!r}")
    global _wanted
    _wanted = wanted


def is_wanted() -> bool:
    """Whether what takes long is to be shown, though a call does not say so."""
    return (_console.is_terminal or _console.is_jupyter) if _wanted is None else _wanted


def progress_line(*columns: ProgressColumn, transient: bool = False) -> Progress:
    """A line, not shown yet, for what takes long; transient: whether it goes when it ends."""
    return Progress(*columns, console=_console, transient=transient)


class Activity:
    """Something that may take long, while it lasts; its line is shown if it does.

    name: what it is; wanted: whether it is shown: at once, never, or (None) as everything is.
    """

    #: Those that have begun and not ended, the outermost one first.
    under_way: ClassVar[list["Activity"]] = []
    #: The names of those that ended well before: what they do is compiled.
    known: ClassVar[set[str]] = set()
    lock: ClassVar[Any] = threading.RLock()

    def __init__(self, name: str, wanted: bool | None = None):
        self.name, self.wanted, self.began = name, wanted, time.monotonic()
        self.text = "" if name in self.known else "the first time it is compiled"
        self.line: Progress | None = None
        self.patience: threading.Timer | None = None

    def __enter__(self) -> "Activity":
        with self.lock:
            is_outermost = not self.under_way
            self.under_way.append(self)
        if is_outermost and (is_wanted() if self.wanted is None else self.wanted):
            self.patience = threading.Timer(0.0 if self.wanted else SHOWN_AFTER, self._show)
            self.patience.daemon = True
            self.patience.start()
        return self

    def _show(self) -> None:
        with self.lock:
            if self in self.under_way:
                columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
                self.line = progress_line(*columns, transient=True)
                self.task = self.line.add_task(self._words())
                self.line.start()

    def _words(self) -> str:
        return f"{self.name}: {self.text}" if self.text else self.name

    def say(self, text: str) -> None:
        """From now on this is what it does."""
        with self.lock:
            self.text = text
            if self.line is not None:
                self.line.update(self.task, description=self._words())

    def __exit__(self, kind: Any, *_: Any) -> None:
        if self.patience is not None:
            self.patience.cancel()
        with self.lock:
            self.under_way.remove(self)
            if self.line is not None:
                self.line.stop()
            if kind is None:
                self.known.add(self.name)
        logger.info("%s: %.3g s", self.name, time.monotonic() - self.began)


def announced(name: str) -> Callable[[Callable], Any]:
    """Makes a function one that says what it does while it takes long, and that tells its arguments
    where one has another name; name: of the function."""

    def decorate(function: Callable) -> Callable:
        names = list(inspect.signature(function).parameters)

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            refuse_other_names(name, names, kwargs)
            with Activity(name):
                return function(*args, **kwargs)

        return call

    return decorate


def note_progress(text: str) -> None:
    """Say how far the outermost activity is."""
    logger.debug(text)
    outermost = Activity.under_way[:1]
    for activity in outermost:
        activity.say(text)
