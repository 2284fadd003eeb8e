"""What XLA compiles while something runs."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax


@contextmanager
def compilations() -> Iterator[list[str]]:
    """The names of the programs that are compiled in the block, as they are."""
    compiled: list[str] = []

    def listen(name: str, *_, fun_name: str = "", **__) -> None:
        if name.endswith("backend_compile_duration"):
            compiled.append(fun_name)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
