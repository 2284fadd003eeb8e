"""Periodic motions of forced oscillators: `periodic` and `PeriodicMotion`.

An orbit is followed for n periods of the forcing; its arcs are the signature and the guess from
which `clocked` solves for the motion that repeats after them.
"""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
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
    require,
    require_outside_of_jit,
)
from ..model.events import signature_name
from ..model.modes import STUCK
from ..model.oscillator import Oscillator, check_clock, check_oscillator, has_possible_numbers
from ..model.own_units import OwnOscillator, in_given_units, in_own_units, quantity, rescaled
from ..motion.arcs import Ends
from ..numerics.compiling import is_outermost, jit
from ..numerics.implicit import solution
from ..numerics.newton import HOLDS, solve
from ..results import Status, describe, draw
from ..tables import per_belt, require_single, table_of
from .chains import SIZES, Loop, blank_loop, first_failure
from .clocked import (
    TimedChain,
    TimedClosed,
    extrema_along,
    forcing_period,
    monodromy,
    multipliers_of,
    states_at_phase,
    timed_admissible,
    timed_chain_of,
    timed_residual,
    turns_of,
)
from .followed import PERIODS_AT_ONCE, Followed, after_period, arcs_over
from .motions import ClosedMotion

if TYPE_CHECKING:
    import pandas

#: Error of the equations that integration steps may leave; how often steps are halved to reach it.
EXACT_MOTION, MESH_HALVINGS = 1e-11, 3
#: Newton's method has settled if unknowns move by less; near a fold rounding moves them by 1e-9 and
#: more.
KNOWN_MOTION = 1e-7
#: States of two motions that differ by less are the same; and states of one motion, each exact to
#: KNOWN_MOTION, where its least number of periods is determined.
SAME_STATE, SAME_OF_MOTION = 1e-7, 1e-6
#: An arc no longer than this may lie between an event and the beginning of a period.
AT_PHASE_0 = 1e-4
#: Least time from an event to where a chain begins, over the longest time between two events.
OFF_EVENTS = 0.25
#: Error of multipliers: nearer to the unit circle they may be on it, as without damping.
ON_THE_CIRCLE = 1e-9
#: Advice of the error message where periodic motions cannot be searched for.
IN_TRACES = "under jit and vmap use motion.at(osc) of a motion that was found outside"
#: Newton steps on the state at phase 0 where the followed arcs are not those of the motion.
OUTER_STEPS = 12


class PeriodicMotion(ClosedMotion):
    """A motion of a forced oscillator that repeats after n periods of the forcing.

    Differentiable with respect to every parameter of its oscillator.

    Attributes:
        oscillator: The oscillator.
        chain: Its arcs; padded. They begin at the phase 0, or, where events are near to that, at
            another phase, `chain.share` of a period.
        unknowns: (x1, x2, t, duration) at the entry of every arc, t counted from the last phase 0
            before the arcs of a period begin, [arcs, 4].
        multipliers: Both Floquet multipliers, complex, the larger one first, both with an error of
            about 1e-15 of the larger; how areas shrink beyond that only `lyapunov` tells. If the
            motion sticks, the second is exactly 0.
        residual: Largest error in the equations.
        iterations: Newton steps.
        status: A `Status` code; where it is not OK every number is NaN.
    """

    oscillator: Oscillator
    chain: TimedChain
    unknowns: Array = eqx.field(metadata=quantity("length", "velocity", "time", "time"))
    multipliers: Array
    residual: Array
    iterations: Array
    status: Array

    @property
    def periods(self) -> int:
        """Number of periods of the forcing after which it repeats."""
        return periods_of(self.chain)

    @property
    def _period_ends(self) -> Array:
        return jnp.sum(jnp.where(self.chain.ends == self._ends.period, 1.0, 0.0), axis=-1)

    @property
    def _ends(self) -> Ends:
        return Ends(self.chain.codes.shape[-1])

    @property
    def period(self) -> Array:
        """Its own period, `periods` times that of the forcing."""
        own = self._period_ends * forcing_period(self.oscillator, self.chain.turns)
        return own * (0.0 * self.residual + 1.0)

    @property
    def start(self) -> Array:
        """The state (x1, x2) at the phase 0: at t = 0."""
        if self.chain.share is None:
            return self.unknowns[..., 0, :2]
        return _first_state(_at_phase_0(self))

    @property
    def since_beginning(self) -> Array | None:
        share = self.chain.share
        if share is None:
            return None
        return (1.0 - share) * forcing_period(self.oscillator, self.chain.turns)

    @property
    def starts(self) -> Array:
        """The states (x1, x2) at the phase 0 of each of its periods, [periods, 2]."""
        if self.chain.share is not None:
            states = _at_phase_0(self)
            passes = np.flatnonzero(np.isfinite(np.asarray(states[:, 0])))
            # Without a motion all states are NaN: return as many rows as it has periods.
            return states[passes if passes.size else np.arange(self.periods)]
        cuts = np.flatnonzero(np.asarray(self.chain.ends) == self._ends.period)
        return self.unknowns[jnp.asarray(np.append(0, cuts[:-1] + 1)), :2]

    def _extremum(self, number):
        return extrema_of(self)[..., number]

    @property
    def stable(self) -> Array:
        """Whether both multipliers are inside of the unit circle, and not on it up to rounding."""
        return jnp.all(jnp.abs(self.multipliers) < 1 - ON_THE_CIRCLE, axis=-1)

    def at(self, osc: Oscillator) -> "PeriodicMotion":
        """The motion of another oscillator, close to its own, with the same signature.

        Works under `jax.jit`, `jax.vmap` and derivatives. There it keeps the steps of integration
        of this motion; where they are too long for the other one its status is NO_CONVERGENCE.

        Args:
            osc: An oscillator with the same belts and forces, but for their numbers.

        Returns:
            The motion; its status tells where there is none.
        """
        check_oscillator(osc)
        own = in_own_units(osc)
        is_single = self.unknowns.ndim == 2
        if is_outermost(own, self) and is_single:
            found = motion_at_unknowns(own, *self._guess_for(osc, own))
            if int(found.status) == Status.NOT_ADMISSIBLE:
                moved = self._begun_off_events()
                if moved is not self:
                    found = motion_at_unknowns(own, *moved._guess_for(osc, own))
            return in_given_units(found, osc, own)
        # In a batch of oscillators, an event may cross the phase 0 for some of them.
        known = self._begun_off_events() if is_single and is_outermost(self) else self
        found, _ = _polished_motion(own, *known._guess_for(osc, own), jnp.asarray(HOLDS))
        return in_given_units(found, osc, own)

    def _guess_for(self, osc: Oscillator, own: OwnOscillator) -> tuple[TimedChain, Array]:
        """Its chain, and its unknowns in the own units of an oscillator."""
        z = self.unknowns
        if own is not osc:
            z = jnp.concatenate([own.units.into(z[..., :2]), z[..., 2:]], axis=-1)
        return self.chain, lax.stop_gradient(z)

    def _begun_off_events(self) -> "PeriodicMotion":
        """`begun_off_events` of this motion, in the oscillator's own units and back."""
        own = in_own_units(self.oscillator)
        if own is self.oscillator:
            return begun_off_events(own, self)
        motion = rescaled(self, 1 / own.units.length, lambda _: own)
        moved = begun_off_events(own, motion)
        return self if moved is motion else in_given_units(moved, self.oscillator, own)

    def row(self) -> dict[str, Any]:
        """The row of the motion in `table`."""
        require_single(self, self.residual, 0)
        known = int(self.status) == Status.OK
        start, (first, second) = np.asarray(self.start), np.asarray(self.multipliers)
        extrema = np.asarray(extrema_of(self))
        numbers = {
            **dict(zip(("x1_min", "x1_max", "x2_min", "x2_max"), extrema, strict=True)),
            "amplitude": 0.5 * (extrema[1] - extrema[0]),
            "period": self.period,
            "x1": start[0],
            "x2": start[1],
            "multiplier_0": first.real,
            "multiplier_0_imaginary": first.imag,
            "multiplier_1": second.real,
            "multiplier_1_imaginary": second.imag,
            **per_belt("stick_duration", self.stick_durations),
            "residual": self.residual,
        }
        return {
            "stable": bool(self.stable),
            "periods": self.periods,
            **{name: float(value) if known else np.nan for name, value in numbers.items()},
            "iterations": int(self.iterations),
            "signature": signature_name(self.signature) if known else "",
            "status": Status(int(self.status)).name,
        }

    def table(self) -> "pandas.DataFrame":
        """One row: stable, periods, x1_min, x1_max, x2_min, x2_max, amplitude (half the range of
        x1), period, x1 and x2 at the phase 0, real and imaginary parts of both multipliers,
        stick_duration_0, ... of each belt, residual, iterations, signature, status."""
        return table_of([self.row()])

    def plot(self, ax: Any = None) -> Any:
        """Draw it in the phase plane, with a dot at the phase 0 of each period, into the axes `ax`
        (None: new ones), which are returned. `ValueError` where there is no motion."""
        return draw(self, ax)

    def __repr__(self) -> str:
        if not is_concrete(self.unknowns) or self.unknowns.ndim != 2:
            return f"PeriodicMotion(unknowns={self.unknowns.shape})"
        if int(self.status) != Status.OK:
            return f"PeriodicMotion({Status(int(self.status)).name}: {describe(self.status)})"
        events = " ".join(f"{kind.name} {belt}" for kind, belt in self.signature) or "smooth"
        sticks = ", ".join(map(number, self.stick_durations))
        found = np.asarray(self.multipliers)
        text = ", ".join(f"{one:.6g}" if one.imag else f"{one.real:.6g}" for one in found.tolist())
        return (
            f"PeriodicMotion({self.periods} periods; {events}; sticks ({sticks}), "
            f"multipliers {text}, {'' if self.stable else 'un'}stable, "
            f"residual {float(self.residual):.1e})"
        )


def extrema_of(motion: PeriodicMotion) -> Array:
    """Smallest and largest x1, then x2, of a motion or of each of a batch, [..., 4]."""
    function = _extrema
    for _ in range(motion.unknowns.ndim - 2):
        function = jax.vmap(function)
    return function(motion.oscillator, motion.chain, motion.unknowns)


_extrema = jit(extrema_along)


def _at_phase_0(motion: PeriodicMotion) -> Array:
    """The states of the arcs of a motion, or of each of a batch, at the phase 0, [..., arcs, 2]."""
    function = passing_states
    for _ in range(motion.unknowns.ndim - 2):
        function = jax.vmap(function, in_axes=(0, 0, 0, None))
    return function(motion.oscillator, motion.chain, motion.unknowns, jnp.zeros(()))


# --- solutions ------------------------------------------------------------------------------------


@jit
def _polished_motion(
    osc: Oscillator, chain: TimedChain, guess: Array, most: Any = np.inf
) -> tuple[PeriodicMotion, Array]:
    """The motion near a guess of a chain's unknowns, and the error that its integration steps
    leave; where this exceeds `most`, the status is NO_CONVERGENCE."""
    solved = solve(TimedClosed(chain), osc, guess)
    # A motion that sticks all the time may lie anywhere: the guess is a solution, or there is none.
    always = jnp.all(jnp.any(chain.codes == STUCK, axis=-1) | ~chain.used)
    z, settled = jnp.where(always, guess, solved.z), solved.unsettled
    still, at = lax.stop_gradient((osc, z))
    values = chain.on_both_meshes(lambda one: timed_residual(still, one, at))
    error = jnp.max(jnp.abs(values[0] - values[1]))
    residual = jnp.max(jnp.abs(values[0]))
    fine = (residual < HOLDS) & (settled < KNOWN_MOTION) & (error <= most)
    status = jnp.where(fine, Status.OK.value, Status.NO_CONVERGENCE.value)
    status = jnp.where(always & (residual < HOLDS), Status.NEUTRAL.value, status)
    status = jnp.where(has_possible_numbers(osc), status, Status.NOT_FINITE.value)
    return motion_at(osc, chain, z, residual, solved.iterations, status), error


def motion_at(osc, chain, z, residual, iterations, status) -> PeriodicMotion:
    """The motion with the unknowns z; NaN, and a status, where these are no motion."""
    inside = timed_admissible(*lax.stop_gradient((osc, chain, z)))
    status = first_failure(status, inside, Status.NOT_ADMISSIBLE)
    return _motion(osc, chain, z, residual, iterations, status)


def _motion(osc, chain, z, residual, iterations, status) -> PeriodicMotion:
    known = jnp.where(status == Status.OK, 1.0, jnp.nan)
    found = multipliers_of(monodromy(osc, chain, z), chain.sticks)
    found, numbers = found * known.astype(complex), (residual * known, iterations, status)
    return PeriodicMotion(osc, chain, z * known, found, *numbers)


@jit
def _motion_with_derivatives(osc: Oscillator, motion: PeriodicMotion) -> PeriodicMotion:
    """A motion found before, as a differentiable function of its oscillator."""
    chain, status = motion.chain, motion.status
    z = solution(TimedClosed(chain), osc, lax.stop_gradient(motion.unknowns))
    return _motion(osc, chain, z, motion.residual, motion.iterations, status)


def solved_from(
    osc: Oscillator, loop: Loop, turns: int, share: Array | None = None
) -> PeriodicMotion:
    """The motion near a loop, with as many integration steps as it needs; share: see
    `TimedChain`."""
    chain, guess = timed_chain_of(osc, loop, turns, share)
    motion, error = _polished_motion(osc, chain, guess)
    for _ in range(MESH_HALVINGS):
        converged = int(motion.status) in (Status.OK, Status.NOT_ADMISSIBLE)
        if not converged or float(error) < EXACT_MOTION:
            break
        chain = chain.halved
        finer, remaining = _polished_motion(osc, chain, guess)
        if float(remaining) > 0.1 * float(error):
            break  # the rest is rounding
        motion, error = finer, remaining
    return motion


def motion_at_unknowns(osc: Oscillator, chain: TimedChain, z: Array) -> PeriodicMotion:
    """The motion near the unknowns of a chain, which may be of another oscillator; it gets
    integration steps of its own where those of the chain leave an error."""
    motion, error = _polished_motion(osc, chain, z)
    converged = int(motion.status) in (Status.OK, Status.NOT_ADMISSIBLE)
    if not converged or float(error) < EXACT_MOTION:
        return motion
    return solved_from(osc, chain.loop(z), chain.turns, chain.share)


def _without_doubles(osc: Oscillator, motion: PeriodicMotion) -> PeriodicMotion:
    """The motion; its chain begins at another phase where an event at the phase 0 may occur at
    both ends of the chain."""
    if int(motion.status) != Status.OK:
        return motion
    used = np.asarray(motion.chain.used)
    shortest = np.min(np.asarray(motion.unknowns)[used, 3])
    return begun_off_events(osc, motion) if shortest < AT_PHASE_0 else motion


def begun_off_events(osc: Oscillator, motion: PeriodicMotion) -> PeriodicMotion:
    """The motion with a chain that begins where no event is near: in the middle of the longest time
    between any two phases with events, before the phase 0 of `motion.start`.

    The motion is returned unchanged where that is hardly farther from events, or where the orbit
    from there leads to another motion. osc: its oscillator, concrete, in own units.
    """
    chain = motion.chain
    share = phase_off_events(osc, motion) if int(motion.status) == Status.OK else None
    if share is None:
        return motion
    state = state_near_start(osc, motion, share, before=True)
    followed = arcs_over(osc, state, chain.turns, share)
    if len(followed.starts) <= motion.periods:
        return motion
    loop = followed.first(motion.periods).loop()
    found = solved_from(osc, loop, chain.turns, jnp.asarray(share))
    same = int(found.status) == Status.OK and is_same_motion(found, motion)
    return found if same else motion


def phase_off_events(osc: Oscillator, motion: PeriodicMotion) -> float | None:
    """The middle of the longest time between any two phases with events, a fraction of a period;
    None without events, and where the chain begins hardly nearer to one."""
    chain, z = motion.chain, np.asarray(motion.unknowns)
    period = float(forcing_period(osc, chain.turns))
    ends = np.asarray(chain.ends)[np.asarray(chain.used)]
    is_event = np.roll(ends != Ends(len(osc.belts)).period, 1)
    phases = np.sort(z[: len(ends)][is_event, 2] / period % 1.0)
    if not phases.size:
        return None
    gaps = np.diff(phases, append=phases[0] + 1)
    widest = int(np.argmax(gaps))
    begins = 0.0 if chain.share is None else float(chain.share)
    off = np.abs(phases - begins)
    if np.min(np.minimum(off, 1 - off)) >= OFF_EVENTS * gaps[widest]:
        return None
    return float((phases[widest] + 0.5 * gaps[widest]) % 1.0)


def state_near_start(
    osc: Oscillator, motion: PeriodicMotion, share: float, *, before: bool = False, later: int = 0
) -> np.ndarray:
    """The state of a motion at a fraction of a period, `share`: the first one after `motion.start`,
    the last one before it (`before`), or that `later` periods after the first."""
    chain = motion.chain
    states = np.asarray(passing_states(osc, chain, motion.unknowns, jnp.asarray(share)))
    passes = np.flatnonzero(np.isfinite(states[:, 0]))
    # Whether the first of these states is before the first phase 0 of the chain.
    is_first = chain.share is not None and share >= float(chain.share)
    place = (0 if is_first else -1) if before else (int(is_first) + later) % len(passes)
    return states[passes[place]]


def periods_of(chain: TimedChain) -> int:
    """How many periods a chain has; of a batch, the largest number."""
    is_end = np.asarray(chain.ends) == Ends(chain.codes.shape[-1]).period
    return int(np.max(np.sum(is_end, axis=-1)))


passing_states = jit(states_at_phase)


def state_at_phase_0(osc: Oscillator, chain: TimedChain, z: Array) -> np.ndarray:
    """The state at the phase 0 by the unknowns of a chain, which need not solve its equations."""
    if chain.share is None:
        return np.asarray(z)[0, :2]
    return np.asarray(_first_state(passing_states(osc, chain, z, jnp.zeros(()))))


def _first_state(states: Array) -> Array:
    """The first of the states, [..., arcs, 2], that is not NaN, if there is one."""
    first = jnp.argmax(jnp.isfinite(states[..., 0]), axis=-1)
    return jnp.take_along_axis(states, first[..., None, None], axis=-2)[..., 0, :]


def nothing_found(osc: Oscillator, turns: int, status: int) -> PeriodicMotion:
    """A motion of NaN, with the status that says why there is none."""
    arcs, loop = SIZES[0], blank_loop(SIZES[0], len(osc.belts))
    chain = TimedChain(loop.codes, loop.ends, jnp.zeros((arcs, 1)), turns=turns)
    nan, none = jnp.asarray(jnp.nan), jnp.full((arcs, 4), jnp.nan)
    found = jnp.full(2, jnp.nan, complex)
    return PeriodicMotion(osc, chain, none, found, nan, jnp.asarray(0), jnp.asarray(status))


def periodic_from(
    osc: Oscillator, guess: Any, periods: int, turns: int, share: float = 0.0
) -> PeriodicMotion:
    """What `periodic` returns, for a concrete oscillator in its own units.

    share: fraction of a period at which the guess is; the motion's chain begins there.
    """
    y = np.asarray(guess, float)
    motion, begun_again = None, False
    begins = jnp.asarray(share) if share else None
    for _ in range(OUTER_STEPS):
        followed = arcs_over(osc, y, turns, share)
        if len(followed.starts) <= periods:
            status = followed.status or Status.NOT_FINITE.value
            return motion or nothing_found(osc, turns, int(status))
        followed = followed.first(periods)
        motion = solved_from(osc, followed.loop(), turns, begins)
        if int(motion.status) in (Status.OK, Status.NEUTRAL):
            goes_on = np.array_equal(followed.codes[0], followed.codes[-1])
            if goes_on or begun_again:
                return of_least_periods(osc, motion, turns)
            # First and last mode differ: an arc of duration zero lies before an event.
            begun = np.asarray(motion.unknowns)[:1, :2]
            y = after_period(osc, followed._replace(starts=begun))
            begun_again = True
            continue
        change = _period_step(osc, followed, turns, begins)
        size = float(np.max(np.abs(change)))
        if not 0 < size < np.inf:
            break
        y = y + change * min(1.0, 0.5 / size)
    return motion if motion is not None else nothing_found(osc, turns, Status.NO_CONVERGENCE)


def _period_step(
    osc: Oscillator, followed: Followed, turns: int, begins: Array | None
) -> np.ndarray:
    """The Newton step of the state where periods begin to that of a periodic motion, [2],
    linearised along the followed orbit."""
    loop = followed.loop()
    chain, z = timed_chain_of(osc, loop, turns, begins)
    matrix = np.asarray(monodromy_of(osc, chain, z))
    miss = followed.starts[-1] - followed.starts[0]
    if not np.all(np.isfinite(matrix)):
        return np.full(2, np.nan)
    return np.linalg.lstsq(np.eye(2) - matrix, miss, rcond=None)[0]


monodromy_of = jit(monodromy)


def of_least_periods(osc: Oscillator, motion: PeriodicMotion, turns: int) -> PeriodicMotion:
    """The motion with the least number of periods after which it repeats."""
    if int(motion.status) != Status.OK:
        return motion
    periods, starts = motion.periods, np.asarray(motion.starts)
    for least in (one for one in range(1, periods) if periods % one == 0):
        apart = np.max(np.abs(starts - np.roll(starts, -least, axis=0)))
        if apart < SAME_OF_MOTION * (1 + np.max(np.abs(starts))):
            return solved_from(osc, arcs_over(osc, starts[0], turns).first(least).loop(), turns)
    return motion


def motion_between_halves(
    osc: Oscillator, motion: PeriodicMotion, turns: int
) -> PeriodicMotion | None:
    """The motion of half as many periods, from which this one may have branched in a period
    doubling; None if there is none."""
    half, odd = divmod(motion.periods, 2)
    if odd:
        return None
    starts = np.asarray(motion.starts)
    between = periodic_from(osc, 0.5 * (starts[0] + starts[half]), half, turns)
    return between if int(between.status) == Status.OK else None


@announced("periodic")
def periodic(osc: Oscillator, guess: ArrayLike | tuple, *, periods: int = 1) -> PeriodicMotion:
    """The periodic motion of a forced oscillator near a guess, stable or not, sticking or not.

    By Newton's method. Differentiable with respect to the parameters of the oscillator, not under
    `jax.jit` or `jax.vmap`: there use `motion.at(osc)`.

    Args:
        osc: An `Oscillator` with forcing.
        guess: State (x1, x2) at the phase 0, that is, at t = 0, shape [2].
        periods: Number of periods of the forcing after which it repeats, 32 at most. A motion that
            repeats earlier is returned with its own number.

    Returns:
        The motion; where there is none its status says why.

    Raises:
        ValueError: If an argument is impossible, or if the frequencies have no common period.

    Example:
        motion = jb.periodic(osc, guess=(0.5, 0.2), periods=2)
        motion.multipliers, motion.stable, motion.start
    """
    check_oscillator(osc)
    check_clock(osc, "periodic", "jb.find_cycle or jb.unstable_cycle")
    guess = as_finite(guess, "guess", (2,))
    periods = as_whole(periods, "periods")
    require(periods <= PERIODS_AT_ONCE, "periods", f"at most {PERIODS_AT_ONCE}", periods)
    require_outside_of_jit("periodic", IN_TRACES, osc=osc, guess=guess)
    return differentiable_motion(
        osc, guess, lambda o, y, turns: periodic_from(o, y, periods, turns)
    )


def differentiable_motion(osc: Oscillator, y: Array, find: Any) -> PeriodicMotion:
    """The motion that find(osc, y, turns) returns for the concrete oscillator in own units, as a
    differentiable function of `osc`."""
    still, y = lax.stop_gradient((osc, y))
    turns = turns_of(still)
    own = in_own_units(still)
    motion = find(own, np.asarray(y if own is still else own.units.into(y)), turns)
    motion = _without_doubles(own, motion)
    if is_concrete(osc):
        return in_given_units(motion, osc, own)
    own = in_own_units(osc)
    return in_given_units(_motion_with_derivatives(own, motion), osc, own)


def is_same_motion(one: PeriodicMotion, other: PeriodicMotion) -> bool:
    """Whether two motions are the same, whichever of their periods comes first."""
    if one.periods != other.periods:
        return False
    a, b = np.asarray(one.starts), np.asarray(other.starts)
    gaps = [np.max(np.abs(a - np.roll(b, k, axis=0))) for k in range(len(a))]
    size = np.max(np.abs(np.asarray(one.unknowns)[:, :2]))
    return bool(min(gaps) <= SAME_STATE * size)
