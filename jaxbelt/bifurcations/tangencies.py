"""Cycles tangent to the boundary of a belt: `NonsmoothFold` and `GrazingSliding`.

The arc before the stick phase meets the boundary tangentially, r = 0 and x2' = 0, which for a law
without a jump is the point of slip onset. That arc is followed backwards from the point of
tangency, so trial solutions cannot overshoot; that it arrives at its entry is one more equation.
Both kinds are this same event. They differ in the multiplier m that the cycle has at the point if
that stick phase is left out. The return map has slope 0 where the cycle sticks and slope m where it
does not: for m > 1 both its fixed points lie on one side and vanish together (fold); for m < 1, one
lies on either side, and the cycle continues (grazing). A cycle with another stick phase has m = 0.
Where the law jumps, static > mu(0+), the stick phase that begins at the tangency has a positive
duration, and an orbit without it differs: the return map jumps, m = inf, and the cycle ends there.

The paper's cycles end with a nonsmooth fold (its section 3); grazing-sliding is the name of M. di
Bernardo, C. Budd, A. Champneys, P. Kowalczyk, Piecewise-smooth Dynamical Systems, 2008.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..cycles.chains import SIZES, Chain, Loop, first_failure
from ..cycles.closure import admissible
from ..cycles.orbits import Orbit, follow, last_loop, loop_of
from ..cycles.shooting import meshed
from ..model.families import Family
from ..model.modes import STUCK, mode_acceleration, mode_of, select, velocity_of
from ..model.oscillator import Oscillator
from ..model.pseudofocus import derivatives_at_rest
from ..motion.arcs import Ends
from ..numerics.compiling import jit
from ..numerics.newton import HOLDS, newton
from ..results import EventKind, Status
from .base import Line
from .conditions import AbstractStickCondition
from .forced import TimedGrazing
from .guesses import HINT_BUDGET, least_push, orbit_after_stick
from .special import SpecialPoint, extrapolated_to_zero
from .systems import (
    CycleSystem,
    contact_tests,
    nearest_contacts,
    nearest_edge,
    stick_phase_from,
)

#: Distance from an equilibrium from which on its unstable manifold is followed: the error is about
#: its third power, divided by the velocity at which the friction law bends, 1/p3 for Conti's law.
#: With 1e-4 the limit of class (b) at nu1 = -0.2839 is off by 5e-12, with 1e-5 by no more than
#: 1e-14.
DEPARTURE = 1e-5
#: Integration steps for each arc of that orbit; it takes long to leave.
DEPARTURE_STEPS = 48


class Encounter(CycleSystem):
    """Two belts have one velocity; if `belts` is one belt twice, an arc is tangent to its boundary.

    row: first arc of the stick phase that begins at the tangency, -1 if there is none; wanted: see
    `AbstractTangency`.
    """

    chain: Chain
    belts: Array
    row: Array
    wanted: float | Array

    def condition(self, osc, z, miss):
        difference = velocity_of(osc, self.belts[0]) - velocity_of(osc, self.belts[1])
        return jnp.where(self.belts[0] != self.belts[1], difference, miss)

    @property
    def is_tangency(self) -> Array:
        """Whether the condition is a tangency, not two equal velocities."""
        return self.belts[0] == self.belts[1]

    def _other_phases(self, osc: Oscillator) -> Array:
        """Mask, [arcs], of the stick phases that do not begin at the tangency."""
        others = self.chain.used & ~stick_phase_from(osc, self.chain, self.row)
        return others & jnp.any(self.chain.codes == 0, axis=-1)

    def judge(self, osc, z, cycle, slope):
        slope = jnp.where(z[self.row, 2] > 1e-6, jnp.inf, slope)  # below: sqrt(rounding)
        slope = jnp.where(jnp.any(self._other_phases(osc)), 0.0, slope)
        # A tangency is a fold if slope > 1, else grazing. The slope may be inf, and 0 * inf is NaN.
        is_wanted = (self.wanted == 0) | (self.wanted * (slope - 1) >= 0)
        fits = ~self.is_tangency | is_wanted
        status = first_failure(cycle.status, fits, Status.OTHER_KIND)
        return status, jnp.where(self.is_tangency, slope, jnp.nan)

    def watch(self, osc, z, slope):
        sticks = self._other_phases(osc)
        slope = jnp.where(jnp.any(sticks), 0.0, slope)
        nearest, stuck = nearest_contacts(osc, self.chain, z, sticks)
        # A sliding exchange ends where its stick phase vanishes.
        tests = contact_tests("DoubleSliding", nearest, stuck | self.is_tangency)
        alone = self.is_tangency & ~jnp.any(sticks)
        tests["FoldGrazing", ()] = jnp.where(alone, slope - 1, jnp.nan)
        tests["EdgeTouch", ()] = nearest_edge(osc, self.chain, z)
        return tests, True, jnp.where(self.is_tangency, slope, jnp.nan)


class AbstractTangency(AbstractStickCondition):
    """A cycle is tangent to the boundary of a belt.

    wanted: 1 a fold, -1 grazing, 0 either.
    """

    wanted = 0.0
    group: ClassVar[str] = "tangency"
    more_arcs: ClassVar[int] = 1
    bends: ClassVar[bool] = True

    @property
    def sought(self):
        return Tangency(self.belt)

    def as_data(self):
        # One program serves both kinds.
        belt, wanted = (jnp.asarray(np.array(one)) for one in (self.belt, self.wanted))
        return Tangency(belt, wanted)

    def named(self, point):
        return self.kind_along(point.oscillator, float(point.multiplier))(self.belt)

    def kind_along(self, osc, multiplier):
        return NonsmoothFold if multiplier > 1 else GrazingSliding

    def guess(self, osc, size):
        _, _, orbit = orbit_after_stick(osc, self.belt)
        return _nearly_closed(osc, orbit, self.belt, size)

    def system(self, osc, loop, status):
        fits = jnp.sum(loop.used) < loop.ends.size  # it may need one more arc
        status = first_failure(status, fits, Status.TOO_MANY_ARCS)
        loop, row, found = _with_stick(osc, loop, self.belt)
        chain, z = meshed(osc, loop)
        status = first_failure(status, found, Status.NOT_TOUCHED)
        status = jnp.where(velocity_of(osc, self.belt) == 0, Status.STUCK_FOREVER.value, status)
        # The arc before the stick arc is the one that becomes tangent.
        before = (row - 1) % jnp.maximum(jnp.sum(chain.used), 1)
        ends = chain.ends.at[before].set(Ends(len(osc.belts)).tangent + self.belt)
        chain, belts = Chain(chain.codes, ends, chain.mesh), jnp.stack([self.belt, self.belt])
        return Encounter(chain, belts, row, self.wanted), z, status

    def beginnings(self, osc, cycles):
        return [None, *(one.loop for one in cycles)]

    def limit(self, trail):
        """The end of the curve where a belt comes to rest.

        No cycle exists in the limit: slip onset on the belt meets an equilibrium, which the orbit
        takes ever longer to leave. Of the two unstable directions of the equilibrium the stronger
        one wins: the part along the weaker one goes like the power 1 - weak/strong of the velocity.
        So in the limit the orbit along the stronger direction is tangent to the boundary, which is
        a regular problem.
        """
        stopping = trail.stopping()
        if stopping is None:
            return None
        held, free = stopping.held, trail.values[:, 1 - stopping.held]
        guess = extrapolated_to_zero(stopping.velocities, free)
        belts = jnp.asarray(stopping.belt), jnp.asarray(self.belt)
        # The chain begins at the end of its longest stick phase, the one on the stopping belt.
        codes = jnp.asarray(np.asarray(trail.system.chain.codes)[0])

        def attempt(family, unknowns):
            (p,) = unknowns
            p, residual = _tangent_departure(family, codes, *belts, jnp.asarray(p))
            return (p, residual), (p,)

        still = trail.variation.held(held, stopping.value)
        ((value,), residual), agrees = still.relinearised(attempt, (np.array([guess]),))
        if not (agrees and residual < HOLDS and abs(value - guess) < 3 * trail.step):
            return None
        values = (float(value), stopping.value) if held else (stopping.value, float(value))
        return SpecialPoint("BeltAtRest", (stopping.belt,), values, float(residual))


class Tangency(AbstractTangency):
    """A tangency of either kind, as data for programs."""

    wanted: float | Array = 0.0


class NonsmoothFold(AbstractTangency):
    """The stick phase on a belt shrinks to a point and the cycle vanishes with an unstable one.

    Args:
        belt: Number of the belt.
    """

    wanted = 1.0
    caption: ClassVar[str] = "nonsmooth fold, belt {belt}"
    line: ClassVar[Line] = Line("nonsmooth fold", "black")


class GrazingSliding(AbstractTangency):
    """The cycle touches the boundary of a belt and begins to stick to it there, but continues.

    Args:
        belt: Number of the belt.
    """

    wanted = -1.0
    caption: ClassVar[str] = "grazing, belt {belt}"
    line: ClassVar[Line] = Line("grazing", "#CC79A7")

    def with_clock(self):
        return TimedGrazing(int(self.belt), type(self))

    @classmethod
    def between(cls, before, after, edged):
        # Whether a tangency is a fold or grazing shows at the solution.
        one, other = (label.events(EventKind.STICK) for label in (before, after))
        return [cls(belt) for belt in (one - other) + (other - one)]


# --- guesses --------------------------------------------------------------------------------------


@jit
def _nearly_closed(osc: Oscillator, orbit: Orbit, belt: Array, size: int) -> tuple[Loop, Array]:
    """A loop near the cycle, from the orbit after a stick phase, and a status.

    Either the orbit repeats, or it has left the boundary for good: then its first loop, from slip
    onset to the next extremum of x2 on that side, closed there, is near the cycle.
    """
    n = len(osc.belts)
    velocity = velocity_of(osc, belt)
    repeated = orbit.status == Status.OK
    exits = orbit.exits
    rows = jnp.arange(HINT_BUDGET)
    near = (orbit.ends == Ends(n).extremum_x2) & (exits[:, 1] * jnp.sign(velocity) > 0) & (rows > 0)
    last = jnp.argmax(near)
    # Row 0, the end of the stick phase, is left out. Where slip onset lies on an edge the orbit
    # begins with slip, and row 0 is part of the loop.
    before = jnp.where(jnp.any(orbit.codes[0] == STUCK), 0, -1)
    first_loop = eqx.tree_at(lambda o: (o.repeats, o.count), orbit, (before, last + 1))
    returns = jnp.any(near) & ~jnp.any(
        (rows > 0) & (rows <= last) & jnp.any(orbit.codes == 0, axis=-1)
    )
    orbit = select(repeated, orbit, first_loop)
    _, count = last_loop(orbit)
    status = jnp.where(repeated | returns, Status.OK.value, Status.NOT_TOUCHED.value)
    return loop_of(orbit, size, n), first_failure(status, count <= size, Status.TOO_MANY_ARCS)


def _with_stick(osc: Oscillator, loop: Loop, belt: int | Array) -> tuple[Loop, Array, Array]:
    """A loop with a stick arc on the belt, the row of that arc, and whether there is one.

    It is the stick arc of the given loop that begins most nearly by a tangency. If there is none,
    an arc of duration zero is inserted where x2 comes closest to the boundary from inside.
    """
    velocity = velocity_of(osc, belt)
    rows = jnp.arange(loop.ends.size)
    names = Ends(len(osc.belts))
    arrival, push = least_push(osc, loop, belt)
    has_own = jnp.isfinite(push)
    own = (arrival + 1) % jnp.maximum(jnp.sum(loop.used), 1)

    following = loop.exits
    loops = loop.used & (loop.ends == names.extremum_x2)
    loops = loops & (loop.codes[:, belt] == jnp.sign(velocity))
    loops = loops & (following[:, 1] * jnp.sign(velocity) > 0)
    distance = jnp.abs(velocity - osc.omega * following[:, 1])
    at = jnp.argmin(jnp.where(loops, distance, jnp.inf))

    def inserted(array, new):
        shifted = jnp.roll(array, 1, axis=0)
        after = (rows > at + 1).reshape(-1, *[1] * (array.ndim - 1))
        return jnp.where(after, shifted, array).at[at + 1].set(new)

    # Where all rows are in use the last one is shifted out; the caller checks that.
    new = Loop(
        codes=inserted(loop.codes, loop.codes[at].at[belt].set(STUCK)),
        ends=inserted(loop.ends.at[at].set(belt), jnp.asarray(names.onset)),
        entries=inserted(loop.entries, jnp.stack([following[at, 0], velocity / osc.omega])),
        durations=inserted(loop.durations, jnp.zeros(())),
    )
    loop = select(has_own, loop, new)
    return loop, jnp.where(has_own, own, at + 1), has_own | jnp.any(loops)


# --- the limit at a belt at rest ------------------------------------------------------------------


@jit
def _tangent_departure(family: Family, codes, resting, touched, guess: Array):
    """Value of a parameter for which the orbit from `_departure` is tangent to another boundary.

    The 3N + 1 equations of an `Encounter`, except that the orbit is not closed: it begins on the
    unstable manifold. Returns the residual, too, with every integration step halved; NaN where
    there is no such orbit.
    """
    osc_at, osc = family.at, family.at(guess)
    start = _departure(osc, codes, resting)
    orbit = follow(osc, start, HINT_BUDGET)
    names = Ends(len(osc.belts))
    exits = orbit.exits
    side = jnp.sign(velocity_of(osc, touched))
    loops = (orbit.ends == names.extremum_x2) & (exits[:, 1] * side > 0)
    meets = (loops | (orbit.ends == touched)) & (jnp.arange(HINT_BUDGET) < orbit.count)
    last = jnp.argmax(meets)

    rows = jnp.arange(SIZES[0])
    ends = jnp.where(rows < last, orbit.ends[rows], names.unused)
    ends = ends.at[last].set(names.tangent + touched)
    durations = jnp.where(rows <= last, orbit.durations[rows], 0.0)
    z = jnp.concatenate([orbit.entries[rows], durations[:, None]], axis=1)

    def system(steps):
        chain = Chain(orbit.codes[rows], ends, jnp.full((rows.size, steps), 1 / steps))
        belts, either = jnp.stack([touched, touched]), jnp.zeros(())
        return Encounter(chain, belts, jnp.asarray(-1), either)

    closing = 3 * rows[-1] + jnp.arange(2)  # the two closing equations, replaced by the beginning

    def begins(z, p):
        return z[0, :2] - _departure(osc_at(p), codes, resting)

    def linearized(unknowns):
        z, p = unknowns
        value, matrix = system(DEPARTURE_STEPS).linearized(osc_at, z, p)
        _, slope = jax.jvp(lambda p: begins(z, p), (p,), (jnp.ones(1),))
        row = jnp.zeros((2, value.size)).at[:, :2].set(jnp.eye(2)).at[:, -1].set(slope)
        return value.at[closing].set(begins(z, p)), matrix.at[closing].set(row)

    z, p = newton(linearized, (z, guess)).z
    value = system(2 * DEPARTURE_STEPS).residual(osc_at(p), z).at[closing].set(begins(z, p))
    exists = jnp.any(meets) & (last < SIZES[0]) & admissible(osc_at(p), system(1).ordinary, z)
    return p, jnp.where(exists, jnp.max(jnp.abs(value)), jnp.nan)


def _departure(osc: Oscillator, codes: Array, belt: Array) -> Array:
    """A state on the orbit that leaves a belt at rest at slip onset, into a slip mode.

    It is on the strong unstable manifold of the mode's equilibrium.

    With x2' = -(x1 - rest) + trace x2 + bend x2^2 and eigenvalues strong > weak, whose product is
    one, x1 - rest = weak x2 - weak bend / (2 strong - weak) x2^2 is invariant to third order. NaN
    where the eigenvalues are negative, as nothing departs then, and where they are complex,
    a +- i b: the orbit turns back to the belt within half a loop, on a cycle whose smallest x2 is
    -exp(pi a/b) times the belt's velocity. This cycle shrinks with that velocity, so it touches
    nothing else, and no curve of tangencies to another belt ends here.

    Where the law of the belt jumps, slip onset is not at that equilibrium, and the state is one
    shortly after slip onset, where x2' is the jump.
    """
    mode, zero = mode_of(codes), jnp.zeros(())
    rest = mode_acceleration(osc, mode, zero, zero)
    _, trace, twice_bend, _ = derivatives_at_rest(osc, mode, rest)
    strong = 0.5 * trace + jnp.sqrt(0.25 * trace**2 - 1)
    weak = 1 / strong
    x2 = -codes[belt] * DEPARTURE
    x1 = rest + weak * x2 - 0.5 * weak * twice_bend / (2 * strong - weak) * x2**2
    jumps = [b.load * (b.friction.static - b.friction.mu(zero)) for b in osc.belts]
    jump = codes[belt] * jnp.stack(jumps)[belt]
    is_jump = jnp.abs(jump) > 1e-12
    onset = rest + jump - 0.5 * x2**2 / jnp.where(is_jump, jump, 1.0)
    known = is_jump | (strong > 0)
    return jnp.where(known, jnp.stack([jnp.where(is_jump, onset, x1), x2]), jnp.nan)
