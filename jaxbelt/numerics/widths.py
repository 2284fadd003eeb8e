"""What depends on the device: how much is done side by side, and which form programs have.

The rule stands here alone: `is_cpu` asks for it, `SideBySide` has a number for each side of it, and
`as_on_accelerator` turns it, so that what an accelerator would compute is computed on the CPU.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax

#: Whether programs have the form for accelerators on any device. JAX, and the store of programs,
#: keep separate programs for each value of such a context.
_as_accelerator = jax.make_user_context(default_value=False)


class SideBySide(NamedTuple):
    """How many of something are done at once, or a limit of that.

    Lanes on the CPU are so many that XLA's calls cost nothing beside them, and so few that they
    stay in the nearest cache and need not wait long for the slowest; a device with thousands of
    cores takes as long for a few as for thousands.
    """

    on_cpu: int
    elsewhere: int

    @property
    def here(self) -> int:
        """On JAX's default backend."""
        return self.on_cpu if is_cpu() else self.elsewhere


def is_cpu() -> bool:
    """Whether programs have the form for the CPU: JAX's default backend is one, and
    `as_on_accelerator` is not in force."""
    return jax.default_backend() == "cpu" and not _as_accelerator.value


@contextmanager
def as_on_accelerator() -> Iterator[None]:
    """Programs in the form for accelerators, whatever the device: for tests without one.

    It holds for this thread, see `as_here`.
    """
    with _as_accelerator(True):
        yield


def as_here(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function for another thread, with programs in the form that they have on this one."""
    setting = _as_accelerator.value

    def call(*args: Any, **kwargs: Any) -> Any:
        with _as_accelerator(setting):
            return function(*args, **kwargs)

    return call
