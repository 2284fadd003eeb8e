"""Functionals: scalar functions of a cycle, which can be swept, plotted, fitted or designed.

Each takes a `Cycle`; all but `gap` and the energies take a `PeriodicMotion`, too. It returns a
scalar that is differentiable with respect to the oscillator's parameters, forward and reverse, and
works on batches under `jax.vmap`. All quantities are dimensionless: times in units of 1/omega,
energies in units of k L^2 where L is the unit of length. Where the status of the cycle is not OK
they are NaN.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..activity import announced
from ..checks import check_belt, require_one_of, require_value
from ..model.modes import Mode, mode_acceleration
from ..model.oscillator import Oscillator
from ..numerics.compiling import jit
from .cycle import Cycle
from .periodic import PeriodicMotion
from .shooting import flow


def period(cycle: Cycle | PeriodicMotion) -> Array:
    """Duration of one loop; for a forced motion, of all periods of the forcing until it repeats.

    Args:
        cycle: A cycle, or a motion of a forced oscillator, from `find_cycle` for example.

    Returns:
        The period, in dimensionless time tau.
    """
    return _checked_motion(cycle).period


def stick_duration(cycle: Cycle | PeriodicMotion, belt: int | None = None) -> Array:
    """Time per loop for which the mass sticks to a belt, summed over its stick phases.

    Args:
        cycle: A cycle, or a motion of a forced oscillator, from `find_cycle` for example.
        belt: Number of the belt; None: any belt.

    Returns:
        The duration, in dimensionless time tau.

    Raises:
        ValueError: If there is no such belt.
    """
    if belt is None:
        stuck = jnp.where(_is_stuck(cycle), 1.0, 0.0)
        return jnp.sum(cycle.unknowns[..., -1] * stuck, axis=-1)
    number = _belt_index(cycle, belt)
    return cycle.stick_durations[..., number]


def slip_duration(cycle: Cycle | PeriodicMotion, belt: int | None = None) -> Array:
    """Time per loop for which the mass touches a belt and slips on it.

    Args:
        cycle: A cycle, or a motion of a forced oscillator, from `find_cycle` for example.
        belt: Number of the belt; None: time for which the mass sticks to no belt.

    Returns:
        The duration, in dimensionless time tau.

    Raises:
        ValueError: If there is no such belt.
    """
    if belt is None:
        return _checked_motion(cycle).period - stick_duration(cycle)
    number = _belt_index(cycle, belt)
    codes = cycle.chain.codes[..., number]
    slips = jnp.where(jnp.abs(codes) == 1, 1.0, 0.0)
    return jnp.sum(cycle.unknowns[..., -1] * slips, axis=-1)


def stick_fraction(cycle: Cycle | PeriodicMotion, belt: int | None = None) -> Array:
    """Fraction of a loop for which the mass sticks to a belt.

    Args:
        cycle: A cycle, or a motion of a forced oscillator, from `find_cycle` for example.
        belt: Number of the belt; None: any belt.

    Returns:
        A number from 0 to 1.

    Raises:
        ValueError: If there is no such belt.
    """
    return stick_duration(cycle, belt) / cycle.period


def amplitude(cycle: Cycle | PeriodicMotion, coordinate: str = "x1") -> Array:
    """Half the difference of the largest and the smallest value of a coordinate in a loop.

    Args:
        cycle: A cycle, or a motion of a forced oscillator, from `find_cycle` for example.
        coordinate: "x1" or "x2".

    Returns:
        The amplitude, dimensionless.
    """
    least, largest = _range(cycle, coordinate)
    return 0.5 * (largest - least)


def peak(cycle: Cycle | PeriodicMotion, coordinate: str = "x1") -> Array:
    """Largest absolute value of a coordinate in a loop.

    Args:
        cycle: A cycle, or a motion of a forced oscillator, from `find_cycle` for example.
        coordinate: "x1" or "x2".

    Returns:
        The peak, dimensionless.
    """
    least, largest = _range(cycle, coordinate)
    return jnp.maximum(-least, largest)


def gap(cycle: Cycle, belt: int) -> Array:
    """Signed distance in x2 from the cycle to the boundary r = 0 of a belt, x2 = nu/omega.

    Args:
        cycle: A cycle, from `find_cycle` for example.
        belt: Number of the belt.

    Returns:
        The distance. It is positive where the boundary lies outside of the cycle's range of x2,
        negative where the cycle reaches across it, and zero where the cycle touches it, as it does
        if it sticks to that belt and does not cross its boundary.

    Raises:
        ValueError: If there is no such belt.
    """
    belt = _belt_index(_checked_cycle(cycle), belt)
    osc = cycle.oscillator
    boundary = osc.belts[belt].velocity / osc.omega
    return jnp.maximum(boundary - cycle.x2_max, cycle.x2_min - boundary)


@announced("energy_fed")
def energy_fed(cycle: Cycle) -> Array:
    """Work that the drives of the belts do in one loop: the sum of friction times belt velocity.

    In a steady cycle it equals `energy_dissipated`. Some parts may be negative: a belt can brake.

    Args:
        cycle: A cycle, from `find_cycle` for example.

    Returns:
        The energy, dimensionless.
    """
    return _energies(_checked_cycle(cycle))[0]


@announced("energy_dissipated")
def energy_dissipated(cycle: Cycle) -> Array:
    """Energy that damping and slipping contacts turn into heat in one loop.

    Args:
        cycle: A cycle, from `find_cycle` for example.

    Returns:
        The energy, dimensionless.
    """
    return _energies(_checked_cycle(cycle))[1]


#: Quantity of each functional: the name of one of `Units`, its `coordinate`, or a number.
MEASURED_IN: dict[Callable[..., Array], str] = {
    period: "time",
    stick_duration: "time",
    slip_duration: "time",
    stick_fraction: "number",
    amplitude: "coordinate",
    peak: "coordinate",
    gap: "velocity",
    energy_fed: "energy",
    energy_dissipated: "energy",
}


def _checked_cycle(cycle: Any) -> Any:
    expected = "a Cycle, such as jb.find_cycle(...)"
    forced = " of an oscillator without forcing" if isinstance(cycle, PeriodicMotion) else ""
    require_value(isinstance(cycle, Cycle), "cycle", expected + forced, cycle)
    return cycle


def _checked_motion(cycle: Any) -> Cycle | PeriodicMotion:
    return cycle if isinstance(cycle, PeriodicMotion) else _checked_cycle(cycle)


def _is_stuck(cycle: Cycle | PeriodicMotion) -> Array:
    return jnp.any(_checked_motion(cycle).chain.codes == 0, axis=-1)


def _belt_index(cycle: Cycle | PeriodicMotion, belt: int) -> int:
    check_belt(belt, len(_checked_motion(cycle).oscillator.belts))
    return belt


def _range(cycle: Cycle | PeriodicMotion, coordinate: str) -> tuple[Array, Array]:
    require_one_of(coordinate, ("x1", "x2"), "coordinate")
    motion = _checked_motion(cycle)
    return getattr(motion, f"{coordinate}_min"), getattr(motion, f"{coordinate}_max")


@jit
def _energies(cycle: Cycle) -> Array:
    """[fed, dissipated] in one loop, each the integral of a power over every arc."""

    def one(codes, mesh, unknown):
        return flow(cycle.oscillator, codes, mesh, unknown[:2], unknown[2], _powers)[2:]

    return jnp.sum(jax.vmap(one)(cycle.chain.codes, cycle.chain.mesh, cycle.unknowns), axis=0)


def _powers(osc: Oscillator, mode: Mode, x1: Array, x2: Array) -> Array:
    """Power [fed, dissipated] in a mode. The friction of a stuck contact is minus the needed force.

    Belts that are stuck together share one velocity, so only the sum of their forces counts.
    """
    held = jnp.where(mode.any_stuck, -mode_acceleration(osc, mode, x1, x2), 0.0)
    fed, heat = jnp.zeros(()), osc.damping * x2**2
    counted = jnp.asarray(False)
    for belt, sign, stuck in zip(osc.belts, mode.signs, mode.stuck, strict=True):
        slip = belt.velocity - osc.omega * x2
        friction = sign * (belt.load * belt.friction.mu(jnp.where(stuck, 0.0, sign * slip)))
        friction = jnp.where(stuck & ~counted, held, friction)
        counted = counted | stuck
        fed = fed + friction * (belt.velocity / osc.omega)
        heat = heat + jnp.where(stuck, 0.0, friction * (slip / osc.omega))
    return jnp.stack([fed, heat])
