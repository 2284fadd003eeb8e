"""How a slip arc is integrated: step by step through the smooth field of its mode.

An integrator is a class with two methods: `march` goes from a state until it has left the mode, and
`step` makes one step of a given size, with which `arcs` then finds the place where the mode ends.
`Adaptive`, on diffrax, controls the error of each step; `simulate` uses it for a run by itself.
`Graded` makes steps that are short where the friction law bends; orbits that are followed in search
of a cycle use it, because shooting solves for the cycle afterwards.

A state is a tuple of scalars, (x1, x2), with a clock (x1, x2, t), and a field a function of it.
"""

import abc
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.instants import field_at
from ..model.modes import Mode, fastest_rate, mode_acceleration, share_of_tolerance
from ..model.oscillator import Belt, Oscillator, at_time, fastest, has_clock
from ..numerics.compiling import the_solvers
from ..numerics.extrapolation import increments, scheme

State = tuple[Array, ...]
Field = Callable[[Any], State]

#: Longest and first step of `Adaptive`, as fractions of its span.
MAX_FRACTION, FIRST_FRACTION = 0.5, 0.2
#: Steps of `Adaptive` before an arc is given up.
MAX_ADAPTIVE_STEPS = 100_000
#: Length of a step of `Graded`, times the wanted density. Newton's method mostly takes two steps
#: from orbits of that accuracy.
STRIDE = 0.2
#: Steps of `Graded`, times their stride, before an arc (a quarter of a loop at most) is given up.
MAX_GRADED = 200.0

_ORDER_8 = scheme((2, 4, 6, 8))


class LastStep(NamedTuple):
    """The last step of a march: when and where it began, its length, and the state at its end.

    outside: whether the end is outside of the mode; finished: whether it is, or the time is over.
    """

    t: Array
    start: State
    length: Array
    end: State
    outside: Array
    finished: Array


class AbstractIntegrator(eqx.Module):
    """Integrates the smooth field of a mode; its fields are arrays, or modules of arrays."""

    @abc.abstractmethod
    def march(self, field: Field, y: State, is_outside: Callable[[State], Array]) -> LastStep:
        """Go from y until a step ends outside of the mode, or the integrator's time is over.

        field: of the mode, also beyond its bounds. y: a state in the mode, or on a bound of it that
        the orbit moves away from. is_outside(y): a scalar, true beyond a bound of the mode. Returns
        the last step; all steps before it ended inside.
        """

    def step(self, field: Field, y: State, h: Array) -> State:
        """The state one step of size h after y, as accurate as a step of `march`."""
        (change,) = increments(field, y, h, _ORDER_8)
        return tuple(a + b for a, b in zip(y, change, strict=True))


def slip_field(osc: Oscillator, mode: Mode, y: State) -> State:
    """The field (x1', x2') of a slip mode; with a clock (x1', x2', t'), also of a stick mode."""
    if has_clock(osc):
        x1, x2, t = y
        return field_at(osc, mode, (x1, x2, t))
    x1, x2 = y
    return x2, mode_acceleration(osc, mode, x1, x2)


# --- steps whose error is controlled --------------------------------------------------------------


@functools.cache
def _extrapolation() -> Any:
    """The solver of `Adaptive`."""
    dfx = the_solvers()

    class _Extrapolation(dfx.AbstractAdaptiveSolver):
        """The midpoint rule extrapolated to order eight, the error from the extrapolation to six.

        Its state is where its last step began and where it ended, (t, x1, x2) each.
        """

        scheme: ClassVar = scheme((2, 4, 6, 8), (2, 4, 6))
        term_structure = dfx.ODETerm
        interpolation_cls = dfx.LocalLinearInterpolation

        def order(self, terms):
            return 7  # that of the controlled error

        def init(self, terms, t0, t1, y0, args):
            return (t0, *y0), (t0, *y0)

        def func(self, terms, t0, y0, args):
            return terms.vf(t0, y0, args)

        def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
            def field(y):
                return terms.vf(t0, y, args)

            best, lower = increments(field, y0, t1 - t0, self.scheme)
            y1 = tuple(a + b for a, b in zip(y0, best, strict=True))
            error = tuple(a - b for a, b in zip(best, lower, strict=True))
            error = args(y0, y1, t1 - t0, error)
            last = (t0, *y0), (t1, *y1)
            return y1, error, {"y0": y0, "y1": y1}, last, dfx.RESULTS.successful

    return _Extrapolation()


class Adaptive(AbstractIntegrator):
    """Steps whose error is kept below rtol and atol, for the time `span`; scalars."""

    osc: Oscillator
    mode: Mode
    span: Array
    rtol: Array
    atol: Array

    def march(self, field, y, is_outside):
        def ends_outside(t, y, args, **kwargs):
            # A rejected first step leaves t = 0, where a guard may vanish.
            return (t > 0) & is_outside(y)

        started, reached, hit = self._integrate(field, y, ends_outside)
        (t_start, *start), (t_end, *end) = started, reached
        hit = jnp.asarray(hit)
        finished = hit | (t_end >= 1)
        t_start, t_end = self.span * t_start, self.span * t_end
        length = jnp.where(finished & ~hit, self.span - t_start, t_end - t_start)
        return LastStep(t_start, tuple(start), length, tuple(end), hit, finished)

    def flow(self, field: Field, y: State) -> State:
        """The state after the time `span`; no events are looked for."""
        _, (_, *end), _ = self._integrate(field, y, None)
        return tuple(end)

    def _integrate(self, field, y, ends_outside):
        """The beginning and the end of the last step, (t, x1, x2) each, t as a fraction of the
        span, and whether it ended outside.

        In units of the span the times are plain numbers; others diffrax checks with a callback,
        which cannot be part of one kernel. Nor can the writes into arrays by which it saves results
        in a batch; so the result is read from the solver's state.
        """

        def scaled(t, y, args):
            return tuple(self.span * slope for slope in field(y))

        def norm(y):
            # A lane that has nothing to do, and may be NaN, must not keep the batch waiting.
            largest = functools.reduce(jnp.maximum, [jnp.abs(part) for part in y])
            return jnp.where(self.span > 0, largest, 0.0)

        layers = _Layers.of(self.osc, self.mode, field, y, self.rtol + self.atol)

        def error_of(start, end, step, error):
            """The error of a step, with what thin layers add, in multiples of the tolerance."""
            share, steps = layers.asked(start, end, self.span * step, self.rtol)
            tolerance = self.atol + self.rtol * jnp.abs(end[1])
            jumps = tolerance * ((steps * steps) ** 2) ** 2
            error = error[0], jnp.maximum(jnp.abs(error[1]) / share, jumps), *error[2:]
            return lax.stop_gradient(error)

        dfx = the_solvers()
        # Where no event is looked for, a step may be as long as its error allows.
        first, longest = (1.0, 1.0) if ends_outside is None else (FIRST_FRACTION, MAX_FRACTION)
        solution = dfx.diffeqsolve(
            dfx.ODETerm(scaled),
            _extrapolation(),
            t0=0.0,
            t1=1.0,
            dt0=first,
            y0=y,
            args=error_of,
            saveat=dfx.SaveAt(solver_state=True),
            stepsize_controller=dfx.PIDController(
                rtol=self.rtol, atol=self.atol, dtmax=longest, norm=norm
            ),
            event=None if ends_outside is None else dfx.Event(ends_outside),
            adjoint=dfx.ForwardMode(),
            max_steps=MAX_ADAPTIVE_STEPS,
            throw=False,
        )
        last: Any = solution.solver_state
        return *last, solution.event_mask


def _oscillator_at(osc: Oscillator, y: State) -> Oscillator:
    """The oscillator without a clock that equals `osc` at a state, see `at_time`."""
    return at_time(osc, y[2]) if has_clock(osc) else osc


class _Layers(eqx.Module):
    """Limits that thin layers of the friction laws at r = 0 set to steps.

    thickness: of the layer of each belt that slips, over omega; inf where the layer is not thin.
    """

    osc: Oscillator
    field: Field
    thickness: tuple[Array, ...]

    @classmethod
    def of(cls, osc: Oscillator, mode: Mode, field: Field, y: State, least: Array) -> "_Layers":
        """least: thickness below which a layer has no effect that counts; thinner ones get it."""
        none = jnp.zeros(())
        bends = [_bends(belt, none) for belt in _oscillator_at(osc, y).belts]
        bends = [
            jnp.where(jnp.abs(code) == 1, osc.omega * bend, 0.0)
            for code, bend in zip(mode.codes, bends, strict=True)
        ]
        thin = [jnp.where(bend > THIN, jnp.maximum(1 / bend, least), jnp.inf) for bend in bends]
        return cls(osc, field, tuple(thin))

    def asked(self, start: State, end: State, h: Array, rtol: Array) -> tuple[Array, Array]:
        """The share of the tolerance that the error of x2 may use, see `share_of_tolerance`, and
        into how many steps this one has to be divided for none to jump a layer: each goes half of
        the way to it."""

        a, now, later = (
            self.field(start)[1],
            _oscillator_at(self.osc, start),
            _oscillator_at(self.osc, end),
        )
        shares, counts = [], []
        for belt, moved, thickness in zip(now.belts, later.belts, self.thickness, strict=True):
            gap, gap_end = (
                x2 - one.velocity / self.osc.omega
                for x2, one in ((start[1], belt), (end[1], moved))
            )
            a_start = a - getattr(belt, "rate", 0.0) / self.osc.omega
            rise = gap_end - gap
            a_end = 2 * rise / h - a_start
            shares.append(share_of_tolerance(rise, a_start, a_end, rtol))
            way = jnp.where(gap * a_start < 0, h * jnp.abs(a_start), 0.0)
            counts.append(2 * way / (thickness + jnp.abs(gap)))
        return functools.reduce(jnp.minimum, shares), functools.reduce(jnp.maximum, counts)


# --- steps that are short where the friction law bends --------------------------------------------


#: Inverse thickness, in own units, of the thickest layer of a friction law at r = 0 that steps
#: might jump unless they look for it.
THIN = 30.0


def _bends(belt: Belt, speeds: Array) -> Array:
    """The inverse lengths sqrt(u0 |mu''|) in which the force of a belt bends, at speeds."""

    def slope(r):
        return jax.jvp(belt.friction.mu, (r,), (jnp.ones_like(r),))[1]

    curvature = jax.jvp(slope, (speeds,), (jnp.ones_like(speeds),))[1]
    return jnp.sqrt(jnp.abs(belt.load * curvature))


def density(osc: Oscillator, mode: Mode, x1: Array, x2: Array, *t: Array) -> Array:
    """How many steps per unit of time an orbit wants: more where the friction law bends.

    With a clock, at the time t, also as many as the fastest wave wants.

    The bend's inverse length is sqrt(u0 |mu''|), about p3 for Conti's law near r = 0. For a steep
    law it is small until the orbit is in the layer at r = 0, which a step of such a length would
    jump: so outside of a layer that is thinner than 1/`THIN` the length is the distance from it,
    and each step goes at most about half of the way. And the density is at least half the rate at
    which disturbances change in the linearised field, which does not show in a small motion.
    """
    waves = [fastest(osc)] if has_clock(osc) else []
    now = _oscillator_at(osc, (x1, x2, *t))
    a, a_by_x2 = jax.jvp(
        lambda x2: mode_acceleration(now, mode, x1, x2), (x2,), (jnp.ones_like(x2),)
    )
    r_slopes, r_curvatures = _relative_motions(osc, mode, a, x1, x2, *t)
    bends, turns = jnp.zeros(()), jnp.zeros(())
    for belt, code, slope, curvature in zip(
        now.belts, mode.codes, r_slopes, r_curvatures, strict=True
    ):
        speed = jnp.maximum(jnp.sign(code) * (belt.velocity - now.omega * x2), 0.0)

        here, at_boundary = _bends(belt, jnp.stack([speed, jnp.zeros_like(speed)]))
        thin = jnp.maximum(0.0, 1.0 - THIN / jnp.maximum(at_boundary, THIN))
        nearing = thin * at_boundary / (1 + at_boundary * speed)
        bend = jnp.where(jnp.abs(code) == 1, jnp.maximum(here, nearing), 0.0)
        bends, turns = bends + bend * jnp.abs(slope), turns + bend * jnp.abs(curvature)
    wanted = 1 + 0.4 * bends + jnp.sqrt(turns)
    return functools.reduce(jnp.maximum, [wanted, 0.5 * fastest_rate(a_by_x2), *waves])


def _relative_motions(osc: Oscillator, mode: Mode, a: Array, x1: Array, x2: Array, *t: Array):
    """r' of each belt up to sign, and r'' likewise where r' = 0; [belts] each."""
    if not has_clock(osc):  # x2'' = -x2 where x2' = 0
        return [osc.omega * a] * len(osc.belts), [osc.omega * x2] * len(osc.belts)

    def slopes(x1, t):
        now = at_time(osc, t)
        a = mode_acceleration(now, mode, x1, x2)
        return [now.omega * a - getattr(belt, "rate", 0.0) for belt in now.belts]

    return jax.jvp(slopes, (x1, *t), (x2, jnp.ones_like(x2)))


class Graded(AbstractIntegrator):
    """Steps of length stride / `density` of the slip mode, as long as |x1| and |x2| are < reach."""

    osc: Oscillator
    mode: Mode
    stride: float | Array = STRIDE
    reach: float | Array = jnp.inf

    def march(self, field, y, is_outside):
        # A stuck lane of a batch has no slip arc to follow; it must not keep the others waiting.
        active = ~self.mode.any_stuck

        def unfinished(state):
            _, _, _, y, steps = state
            near = (jnp.abs(y[0]) < self.reach) & (jnp.abs(y[1]) < self.reach)
            going = (steps * self.stride < MAX_GRADED) & active & near
            return ((steps == 0) | ~is_outside(y)) & going

        def advance(state):
            t, _, h, y, steps = state
            h_new = self.stride / density(self.osc, self.mode, *y)
            return t + h, y, h_new, self.step(field, y, h_new), steps + 1

        zero = jnp.zeros(())
        start = zero, y, zero, y, jnp.asarray(0)
        t, y_start, h, y_end, _ = lax.while_loop(unfinished, advance, start)
        outside = active & is_outside(y_end)
        return LastStep(t, y_start, h, y_end, outside, outside)
