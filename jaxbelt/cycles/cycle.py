"""Steady cycles, stable and unstable: `find_cycle`, `unstable_cycle` and their result, `Cycle`.

A start is followed until a loop of its orbit repeats (`orbits`); that loop is the signature and the
guess from which `shooting` solves for the cycle.
"""

import functools
import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from ..activity import announced
from ..checks import (
    as_finite,
    as_whole,
    is_concrete,
    number,
    pick,
)
from ..model.events import signature_name
from ..model.friction import jump_and_kink
from ..model.modes import select
from ..model.oscillator import Oscillator, check_oscillator, has_clock
from ..model.own_units import in_given_units, in_own_units, quantity
from ..model.rest import is_neutral
from ..motion.arcs import Ends
from ..numerics.compiling import any_lane, in_groups, jit
from ..numerics.newton import HOLDS
from ..numerics.padding import longer
from ..results import Status, describe, draw
from ..tables import per_belt, require_single, table_of
from .chains import SIZES, Chain, Loop, first_failure, modes_of, room_of
from .closure import admissible, closure
from .motions import ClosedMotion
from .orbits import MOST_ARCS, follow, last_loop, loop_of
from .reached import motion_reached
from .shooting import ARC_STEPS, closed, meshed, residual, solve_closed

if TYPE_CHECKING:
    import pandas

#: Integration steps per slip arc where ARC_STEPS leave a larger error in the equations than EXACT,
#: as estimated by halving the steps.
FINE_STEPS, EXACT = 32, 1e-11
#: Numbers of steps tried after FINE_STEPS, outside of traces: for long arcs that creep along a
#: strongly damped oscillator's slow direction.
FINER_STEPS = (128, 512)
#: A solution whose error is a smaller fraction of its size is a cycle: on the way to an
#: equilibrium, which is a double root, each Newton step only halves the remaining distance.
DISTINCT = 1e-2
#: Speeds that differ by less than this part of them count as equal.
SAME_SPEED = 1e-9


class Cycle(ClosedMotion):
    """A steady cycle, differentiable with respect to every parameter of its oscillator.

    A cycle that sticks begins at the end of its longest stick phase, any other at its largest x1.

    Attributes:
        oscillator: The oscillator.
        chain: Its arcs, see `Chain`; padded.
        unknowns: (x1, x2, T) at the entry of every arc, [arcs, 3], in dimensionless units; padded.
        multiplier: Nontrivial Floquet multiplier, the determinant of the monodromy matrix with its
            saltation matrices; exactly 0 where the cycle sticks.
        residual: Largest error in the shooting equations.
        iterations: Number of Newton steps.
        status: A `Status` code; where it is not OK every number is NaN.
    """

    oscillator: Oscillator
    chain: Chain
    unknowns: Array = eqx.field(metadata=quantity("length", "velocity", "time"))
    multiplier: Array
    residual: Array
    iterations: Array
    status: Array

    @property
    def period(self) -> Array:
        """Duration of one loop, in dimensionless time tau."""
        return jnp.sum(self.unknowns[..., 2], axis=-1)

    def _extremum(self, number):
        column = self.unknowns[..., number // 2]
        return (jnp.max if number % 2 else jnp.min)(column, axis=-1)

    @property
    def stable(self) -> Array:
        """Whether it attracts: `|multiplier|` < 1."""
        return jnp.abs(self.multiplier) < 1

    def row(self) -> dict[str, Any]:
        """The row of the cycle in `table`."""
        require_single(self, self.multiplier, 0)
        known = int(self.status) == Status.OK
        x1, x2 = (self.x1_min, self.x1_max), (self.x2_min, self.x2_max)
        numbers = {
            "x1_min": x1[0],
            "x1_max": x1[1],
            "x2_min": x2[0],
            "x2_max": x2[1],
            "period": self.period,
            "amplitude": 0.5 * (x1[1] - x1[0]),
            "multiplier": self.multiplier,
            **per_belt("stick_duration", self.stick_durations),
            "residual": self.residual,
        }
        return {
            "stable": bool(self.stable),
            **{name: float(value) if known else np.nan for name, value in numbers.items()},
            "iterations": int(self.iterations),
            "signature": signature_name(self.signature) if known else "",
            "status": Status(int(self.status)).name,
        }

    def table(self) -> "pandas.DataFrame":
        """Returns one row.

        Columns: stable, x1_min, x1_max, x2_min, x2_max, period, amplitude (half the range of x1),
        multiplier, stick_duration_0, ... of each belt, residual, iterations, signature (its events
        in order, such as stick1-slip1), status. `cycle.arcs.table()` has its arcs.
        """
        return table_of([self.row()])

    def plot(self, ax: Any = None) -> Any:
        """Draws the cycle in the phase plane of its oscillator, with the boundaries and equilibria
        there.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.

        Raises:
            ValueError: If there is no cycle.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        if not is_concrete(self.unknowns) or self.unknowns.ndim != 2:
            return f"Cycle(unknowns={self.unknowns.shape})"
        if int(self.status) != Status.OK:
            return f"Cycle({Status(int(self.status)).name}: {describe(self.status)})"
        events = " ".join(f"{kind.name} {belt}" for kind, belt in self.signature) or "smooth"
        sticks = ", ".join(map(number, self.stick_durations))
        return (
            f"Cycle({events}; period {number(self.period)}, sticks ({sticks}), "
            f"multiplier {number(self.multiplier)}, {'' if self.stable else 'un'}stable, "
            f"residual {float(self.residual):.1e})"
        )


def cycle_of_zeros(osc: Oscillator) -> Cycle:
    """A cycle of zeros with the shapes for that oscillator, to try functions of cycles on."""
    arcs, number, whole = SIZES[0], jnp.zeros(()), jnp.zeros((), int)
    codes, mesh = jnp.zeros((arcs, len(osc.belts))), jnp.zeros((arcs, FINE_STEPS))
    chain = Chain(codes, jnp.zeros(arcs, int), mesh)
    return Cycle(osc, chain, jnp.zeros((arcs, 3)), number, number, whole, whole)


@jit
def as_loop(cycle: Cycle, size: int) -> Loop:
    """A cycle as a loop, padded to `size` arcs."""
    chain, z = cycle.chain, cycle.unknowns
    own = np.arange(size) < len(z)
    source = np.where(own, np.arange(size), 0)
    ends = jnp.where(own, chain.ends[source], Ends(chain.codes.shape[-1]).unused)
    return Loop(chain.codes[source], ends, z[source, :2], jnp.where(own, z[source, 2], 0.0))


def cycle_of(
    osc: Oscillator,
    chain: Chain,
    z: Array,
    iterations: Array,
    status: Array,
    error: Array | None = None,
) -> tuple[Cycle, Array]:
    """The `Cycle` of a solution z, and its multiplier with stick phases left out.

    Where z is no cycle, the numbers are NaN and the status says why. error: the largest error of
    other equations that z is known to solve, in place of the chain's: an arc that was solved for
    backwards may magnify errors a hundred thousand times when it is followed forwards.
    """
    residual, slope = closure(osc, chain, z)
    if error is None:
        status = first_failure(status, residual < HOLDS, Status.NO_CONVERGENCE)
    else:
        residual = error
    status = first_failure(status, admissible(osc, chain, z), Status.NOT_ADMISSIBLE)
    sticks = chain.sticks
    # An equilibrium solves the equations, too, with arcs of any duration.
    moves = sticks | (jnp.max(z[:, 1]) - jnp.min(z[:, 1]) > HOLDS)
    status = first_failure(status, moves, Status.NO_CONVERGENCE)
    known = functools.partial(jnp.where, status == Status.OK)
    cycle = Cycle(
        oscillator=osc,
        chain=chain,
        # A product, so that derivatives are NaN, too.
        unknowns=z * known(1.0, jnp.nan),
        multiplier=jnp.where(sticks, 0.0, slope) * known(1.0, jnp.nan),
        residual=known(residual, jnp.nan),
        iterations=iterations,
        status=status,
    )
    return cycle, slope


@jit
def _loop_reached(osc: Oscillator, y0: Array, size: int) -> tuple[Loop, Array, Array, Array]:
    """The loop that the start leads to, padded to `size` arcs.

    Also returns its number of arcs, a status, and the state at the end of the orbit.
    """
    reached = in_groups(functools.partial(_loop_reached_by_lane, size=size))
    return reached(*lax.stop_gradient((osc, y0)))


def _loop_reached_by_lane(osc: Oscillator, y0: Array, size: int):
    orbit = follow(osc, y0, MOST_ARCS)
    # Where there is no cycle the first arc still gives finite numbers to calculate with.
    loop = orbit.repeats, orbit.count
    loop = select(orbit.status == Status.OK, loop, (jnp.asarray(-1), jnp.asarray(1)))
    orbit = eqx.tree_at(lambda orbit: (orbit.repeats, orbit.count), orbit, loop)
    _, count = last_loop(orbit)
    loop = loop_of(orbit, size, len(osc.belts))
    status = first_failure(orbit.status, ~_loop_is_neutral(osc, loop), Status.NEUTRAL)
    return loop, count, _if_it_fits(status, count, size), orbit.y


def _loop_is_neutral(osc: Oscillator, loop: Loop) -> Array:
    """Whether a loop is one of a continuum of closed orbits."""
    x1, x2 = loop.entries.T
    held = jnp.sum(jnp.where(jnp.any(loop.codes == 0, axis=-1), loop.durations, 0.0))
    extent = (jnp.min(x1), jnp.max(x1)), (jnp.min(x2), jnp.max(x2))
    return is_neutral(osc, *extent, held / jnp.sum(loop.durations))


def _if_it_fits(status: Array, count: Array, size: int) -> Array:
    return first_failure(status, count <= size, Status.TOO_MANY_ARCS)


def exactly(osc: Oscillator, loop: Loop, status: Array) -> Cycle:
    """The cycle near a loop, with as many integration steps as it needs."""
    if not is_concrete((osc, loop, status)):
        return _exactly_in_lanes(osc, loop, status)
    cycle, error = _polished(osc, loop, status, ARC_STEPS)
    coarser = ARC_STEPS
    for steps in (FINE_STEPS, *FINER_STEPS):
        if int(status) != Status.OK or not _is_inexact(cycle, error):
            break
        if int(cycle.status) == Status.NO_CONVERGENCE:
            change = float(_mesh_error(osc, loop, coarser))
            # Across a kink the order drops to two: the estimate with the most steps.
            finest = change * (coarser / FINER_STEPS[-1]) ** 2
            if change < EXACT or (finest > HOLDS and _slips_across_change(osc, loop)):
                break  # the steps are not the cause, or more of them do not help
        coarser = steps
        finer, remaining = _polished(osc, loop, status, steps)
        if int(cycle.status) == Status.OK and remaining > 0.1 * error:
            break  # the rest is rounding
        cycle, error = finer, remaining
    return cycle


def _slips_across_change(osc: Oscillator, loop: Loop) -> bool:
    """Whether the slip speed passes the largest jump or kink of a law along a concrete loop.

    Only a user's law has one.
    """
    slips = _slip_speeds(osc, modes_of(loop), np.asarray(loop.entries)[:, 1])
    for belt, speeds in zip(osc.belts, slips, strict=True):
        for change in jump_and_kink(belt.friction) if speeds.size else ():
            if change is None:
                continue
            inside = (np.min(speeds, axis=0) < change[0]) & (change[0] < np.max(speeds, axis=0))
            if np.any(inside):
                return True
    return False


def _slip_speeds(osc: Oscillator, modes: np.ndarray, x2: np.ndarray) -> list[np.ndarray]:
    """For each belt the slip speeds at both ends of the arcs that slip on it, [2, arcs].

    The loop is concrete. Between its ends an arc's speed is monotone.
    """
    begin = x2[: len(modes)]
    ends = np.stack([begin, np.roll(begin, -1)])
    return [
        np.abs(float(belt.velocity) - float(osc.omega) * ends[:, np.abs(codes) == 1])
        for belt, codes in zip(osc.belts, modes.T, strict=True)
    ]


def warn_of_extrapolation(cycles: Iterable[Cycle], depth: int = 4) -> None:
    """Warns where concrete cycles slip faster than the measured range of a belt's friction.

    depth: the `stacklevel` of the caller of the public function.
    """
    known = (one for one in cycles if is_concrete(one) and int(one.status) == Status.OK)
    loops = ((one.oscillator, one.chain, np.asarray(one.unknowns)[:, 1]) for one in known)
    warn_of_fast_loops(loops, depth + 1)


def warn_of_fast_loops(
    loops: Iterable[tuple[Oscillator, Chain | Loop, np.ndarray]], depth: int
) -> None:
    """`warn_of_extrapolation` for loops of oscillators, with x2 at the entry of each arc."""
    worst, belt = 1.0, 0
    for osc, loop, x2 in loops:
        ends = [float(np.asarray(one.friction.measured_to)) for one in osc.belts]
        if np.all(np.isinf(ends)):
            continue
        slips = _slip_speeds(osc, modes_of(loop), x2)
        for index, (speeds, end) in enumerate(zip(slips, ends, strict=True)):
            part = float(np.max(speeds, initial=0.0)) / end
            worst, belt = (part, index) if part > worst else (worst, belt)
    if worst > 1 + SAME_SPEED:
        warnings.warn(
            f"the mass slips on belt {belt} at {worst:.3g} times the speed at which the table of "
            "its friction ends: results rest on the extrapolation, measure up to there",
            stacklevel=depth,
        )


@jit
def _is_inexact(cycle: Cycle, error: Array) -> Array:
    return (cycle.status == Status.NO_CONVERGENCE) | (error > EXACT)


@jit
def _mesh_error(osc: Oscillator, loop: Loop, steps: int) -> Array:
    """Largest change of the residual of a loop, not yet solved, when its steps are halved."""
    chain, z = meshed(osc, loop, steps)
    values = (residual(osc, one, z)[0] for one in (chain, chain.halved))
    return jnp.max(jnp.abs(jnp.subtract(*values)))


@jit
def _exactly_in_lanes(osc: Oscillator, loop: Loop, status: Array) -> Cycle:
    """`exactly` under a trace: a chain of FINE_STEPS, some of which may have length zero."""
    solved = in_groups(_solved_in_lanes)(*lax.stop_gradient((osc, loop, status)))
    mesh, z, iterations, status = solved
    chain = Chain(loop.codes, loop.ends, mesh)
    return cycle_of(osc, chain, closed(osc, chain, z), iterations, status)[0]


def _solved_in_lanes(osc: Oscillator, loop: Loop, status: Array) -> tuple[Array, ...]:
    """Mesh, unknowns, number of Newton steps, and status."""
    coarse, error = _polished(osc, loop, status, ARC_STEPS)
    mesh = longer(coarse.chain.mesh, FINE_STEPS, axis=-1, fill=0.0)
    found = mesh, *_solution_of(coarse)
    inexact = _is_inexact(coarse, error) & (status == Status.OK)

    def fine():
        # Lanes that are exact enough get a failed status here, so they are not solved again.
        own_status = jnp.where(inexact, status, Status.NO_CONVERGENCE.value)
        finer = polish(osc, loop, own_status, FINE_STEPS)
        return select(inexact, (finer.chain.mesh, *_solution_of(finer)), found)

    return lax.cond(any_lane(inexact), fine, lambda: found)


def _solution_of(cycle: Cycle) -> tuple[Array, Array, Array]:
    return cycle.unknowns, cycle.iterations, cycle.status


@jit
def _polished(osc: Oscillator, loop: Loop, status: Array, steps: int) -> tuple[Cycle, Array]:
    """The cycle near a loop, and the error in its equations with halved steps."""
    chain, guess = meshed(lax.stop_gradient(osc), loop, steps)
    # A lane without a loop starts from NaN: a step that is not finite is the last one, so the other
    # lanes of a batch need not wait.
    guess = jnp.where(status == Status.OK, guess, jnp.nan)
    z, iterations, off = solve_closed(osc, chain, guess)
    error, _ = closure(*lax.stop_gradient((osc, chain.halved, z)))
    # Near a fixed point that hardly attracts or repels all small loops nearly close.
    is_known = off < DISTINCT * jnp.max(jnp.ptp(z[:, :2], axis=0))
    status = first_failure(status, (error < HOLDS) & is_known, Status.NO_CONVERGENCE)
    return cycle_of(osc, chain, z, iterations, status)[0], error


def polish(osc: Oscillator, loop: Loop, status: Array, steps: int = ARC_STEPS) -> Cycle:
    """The cycle near a loop, by Newton's method; all callers share one compiled program."""
    return _polished(osc, loop, status, steps)[0]


#: How often an orbit that has not repeated is followed for MOST_ARCS more: with the multiplier
#: 0.99, in loops of eight arcs, it has then come within 1e-7 of its cycle.
MORE_BUDGETS = 15


@announced("find_cycle")
def find_cycle(osc: Oscillator, y0: ArrayLike | tuple, *, max_arcs: int | None = None) -> Any:
    """The steady cycle that a start leads to.

    The orbit is followed until a loop repeats (up to some thousand loops, under a transformation a
    hundred); then Newton's method solves for all arcs together. The result is differentiable with
    respect to the parameters, forward and reverse, and works under `jax.vmap`. (The derivative with
    respect to y0 is zero: a cycle does not depend on where it was approached from.) At a
    bifurcation point, as where two belts have one velocity, the derivatives of its two sides
    differ, and the returned one may be neither, see `simulate`.

    Args:
        osc: The oscillator.
        y0: Start (x1, x2), shape [2].
        max_arcs: Room for the arcs of one loop, where under a transformation 16 are not enough.

    Returns:
        The `Cycle`. Where the start leads to an equilibrium, to one of a continuum of closed
        orbits, or nothing repeats, its status says so. Of a forced oscillator y0 is the start at
        t = 0, and the `PeriodicMotion` that it leads to is returned, of up to 16 periods of the
        forcing (not under `jax.jit` and `jax.vmap`, see `periodic`); where the orbit is chaotic or
        quasi-periodic its status is NOT_SETTLED.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    check_oscillator(osc)
    y0 = as_finite(y0, "y0", (2,))
    if has_clock(osc):
        return motion_reached(osc, y0)
    room = None if max_arcs is None else as_whole(max_arcs, "max_arcs")
    cycle = cycle_from(osc, y0, room)
    warn_of_extrapolation([cycle])
    return cycle


def cycle_from(osc: Oscillator, y0: Array | np.ndarray, max_arcs: int | None = None) -> Cycle:
    """`find_cycle` without its checks and its warning."""
    own = in_own_units(osc)
    if own is not osc:
        return in_given_units(cycle_from(own, own.units.into(y0), max_arcs), osc, own)
    room = SIZES[-1] if max_arcs is None else max_arcs
    loop, count, status, y = _loop_reached(osc, y0, room)
    for _ in range(MORE_BUDGETS if is_concrete(status) else 0):
        if int(status) != Status.NOT_SETTLED:
            break
        loop, count, status, y = _loop_reached(osc, y, room)
    if max_arcs is None and is_concrete(count):
        needed = int(count) if int(status) == Status.OK else 0
        loop = pick(loop, slice(room_of(needed)))
    elif max_arcs is None:
        loop, status = pick(loop, slice(SIZES[0])), _if_it_fits(status, count, SIZES[0])
    return exactly(osc, loop, status)
