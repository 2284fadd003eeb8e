"""How much is done side by side, which depends on the device."""

from typing import NamedTuple

import jax


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
    """Whether JAX's default backend is the CPU."""
    return jax.default_backend() == "cpu"
