"""Interrupts that are not lost: `heard_interrupts`."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class _Handler:
    """A handler of interrupts that notes them, and raises them where they come if `at_once`.

    It raises none during an import, which would be left half done or end the process, except one
    that was under way when the handler was made, for whole programs may be run by an import.
    """

    def __init__(self, came: threading.Event, at_once: bool):
        self.came = came
        self.at_once = at_once
        self.imports = _imports(sys._getframe())

    def __call__(self, number: int, frame: Any) -> None:
        self.came.set()
        if self.at_once and _imports(frame) <= self.imports:
            signal.default_int_handler(number, frame)

    def raise_noted(self) -> None:
        if self.came.is_set():
            raise KeyboardInterrupt


def _imports(frame: Any) -> int:
    """The number of frames of imports among a frame and its callers."""
    count = 0
    while frame is not None:
        count += frame.f_code.co_filename.startswith("<frozen importlib")
        frame = frame.f_back
    return count


@contextmanager
def heard_interrupts(*, at_once: bool) -> Iterator[Callable[[], None]]:
    """While the block runs no interrupt is lost; such a block inside another one shares its notes.

    Python raises an interrupt wherever the main thread is, and loses it in callbacks of its garbage
    collector, such as JAX has. So the interrupt is noted, too, and raised by the function that the
    block receives, and at the end of the block.

    Args:
        at_once: Whether interrupts are raised where they come, too.
    """
    before = signal.getsignal(signal.SIGINT)
    is_ours = isinstance(before, _Handler)
    is_usual = is_ours or before is signal.default_int_handler
    if not is_usual or threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    handler = _Handler(before.came if is_ours else threading.Event(), at_once)
    told = sys.unraisablehook
    signal.signal(signal.SIGINT, handler)
    sys.unraisablehook = lambda lost: None if lost.exc_type is KeyboardInterrupt else told(lost)
    try:
        yield handler.raise_noted
    finally:
        sys.unraisablehook = told
        signal.signal(signal.SIGINT, before)
    handler.raise_noted()
