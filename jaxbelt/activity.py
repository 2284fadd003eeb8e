"""Progress of functions that take long, on a terminal or in a notebook, after a second.

Such functions are `announced`; inside of them `note_progress` reports how far they are. If they
call one another, the line is that of the outermost one. In scripts and pipes nothing is shown.
The logger "jaxbelt" gets everything in any case: ends at the level INFO, the rest at DEBUG.
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

#: Seconds before a line is shown without a request. On a busy machine it may take another second,
#: and no call should be silent for more than two.
SHOWN_AFTER = 1.0

logger = logging.getLogger("jaxbelt")
logger.addHandler(logging.NullHandler())

_console = Console(stderr=True)
_wanted: bool | None = None


def show_progress(wanted: bool | None = None) -> None:
    """Sets whether functions that take long show their progress.

    The argument `progress` of `sweep` and `basins` comes first.

    Args:
        wanted: True: always; False: never; None: on a terminal and in a notebook, which is the
            default.

    Raises:
        ValueError: If `wanted` is anything else.
    """
    if not (wanted is None or isinstance(wanted, bool)):
        raise ValueError(f"wanted must be True, False or None, got {wanted!r}")
    global _wanted
    _wanted = wanted


def is_wanted() -> bool:
    """Whether progress is shown where a call does not decide it."""
    return (_console.is_terminal or _console.is_jupyter) if _wanted is None else _wanted


def progress_line(*columns: ProgressColumn, transient: bool = False) -> Progress:
    """A progress line, not shown yet; transient: whether it disappears when it ends."""
    return Progress(*columns, console=_console, transient=transient)


class Activity:
    """Something that may take long; a line shows it if it does.

    name: its name; wanted: whether to show the line: at once, never, or (None) by the general
    setting.
    """

    #: Activities that have begun and not ended, the outermost one first.
    under_way: ClassVar[list["Activity"]] = []
    #: Names of activities that ended without an error before: their programs are compiled.
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
        """Sets the text of the line."""
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
    """Decorates a function with an `Activity`, and with a check of the names of its arguments.

    name: of the function, for the line and for messages.
    """

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
    """Reports the progress of the outermost activity."""
    logger.debug(text)
    outermost = Activity.under_way[:1]
    for activity in outermost:
        activity.say(text)
