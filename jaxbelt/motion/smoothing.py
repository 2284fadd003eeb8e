"""Two approximations of the exact motion in common use: the switch model and tanh smoothing.

`switch_field` is the paper's switch model, eqs. (21)-(23): around each boundary lies a band
|r_k| <= v_star in which a contact that can hold moves with the belt, while x2 relaxes to the belt's
velocity. `smooth_field` replaces sgn(r) by tanh(r/eps), so that nothing ever sticks: the mass
creeps. Both are plain vector fields of the state; as v_star and eps go to zero they approach the
exact motion at first order. They are integrated without events, and piece by piece where there are
contact edges: within a piece the contacts stay as they are, so that no interval is jumped and
derivatives have the jumps at edges. At its band the switch field is discontinuous as well, and
derivatives through its integration lack the jumps there: take them from the exact motion.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.modes import (
    ABOVE,
    BELOW,
    STUCK,
    Mode,
    capacity,
    edge_at,
    edge_guards,
    has_edges,
    mode_acceleration,
    select,
    stick_rate,
    stick_velocity,
)
from ..model.oscillator import Oscillator, at_time, constant_force, fastest, has_clock
from ..model.own_units import without_edges
from ..model.transitions import contact
from ..numerics.compiling import the_solvers
from ..numerics.derivatives import forward_jacobian
from .arcs import Ends, arc_to_guard
from .integrators import AbstractIntegrator, LastStep, State
from .runs import SAFETY

#: Largest number of steps between two samples; then a run is given up.
MAX_STEPS_A_SAMPLE = 1_000_000
#: Longest piece between two edges, times the highest frequency; longer ones are cut. Longest and
#: first step of a piece, as fractions of it.
LONGEST_PIECE, LONGEST_OF_PIECE, FIRST_OF_PIECE = 1.0, 0.5, 0.2
#: Between two samples, number of pieces that end at an edge or an extremum, beyond
#: ENDED_PIECES_RATE per unit of time, before a run is given up: it may pass an edge ever faster.
MAX_ENDED_PIECES, ENDED_PIECES_RATE = 5_000, 100.0


def switch_mode(
    osc: Oscillator, x1: Array, x2: Array, v_star: Array, contacts: Mode | None = None
) -> Mode:
    """The mode of the switch model at a state: code 0 for the belts in whose band the mass is held.

    Where the bands of two belts overlap, the first belt that can hold wins; belts of one velocity
    hold together. contacts: which belts touch; None: those at x1.
    """
    if contacts is None:
        slip = contact(osc, x1, x2, rightward=True)
    else:
        signs = contact(without_edges(osc), x1, x2, rightward=True)
        rows = zip(contacts.touching, signs.codes, contacts.codes, strict=True)
        slip = Mode(tuple(jnp.where(touches, sign, code) for touches, sign, code in rows))
    slip = slip.slipping(1.0)
    mode = slip
    for belt in reversed(osc.belts):
        group = [
            touches & (other.velocity == belt.velocity)
            for other, touches in zip(osc.belts, slip.touching, strict=True)
        ]
        held = Mode(
            tuple(
                jnp.where(together, STUCK, code)
                for code, together in zip(slip.codes, group, strict=True)
            )
        )
        in_band = jnp.abs(belt.velocity - osc.omega * x2) <= v_star
        holds = jnp.abs(mode_acceleration(osc, held, x1, x2)) < capacity(osc, held)
        mode = select(in_band & holds, held, mode)
    return mode


def switch_field(
    osc: Oscillator, y: State, v_star: Array, contacts: Mode | None = None
) -> tuple[Array, ...]:
    """(x1', x2') of the switch model, eqs. (21)-(23) of the paper; with a clock (x1', x2', t').

    contacts: which belts touch; None: those at x1.
    """
    x1, x2, *t = y
    osc = at_time(osc, *t) if t else osc
    mode = switch_mode(osc, x1, x2, v_star, contacts)
    velocity = stick_velocity(osc, mode, osc.omega * x2)
    x1_dot = velocity / osc.omega
    x2_dot = (velocity - osc.omega * x2) / osc.omega
    if t:
        x2_dot = x2_dot + stick_rate(osc, mode) / osc.omega
    x2_dot = jnp.where(mode.any_stuck, x2_dot, mode_acceleration(osc, mode, x1, x2))
    return x1_dot, x2_dot, *map(jnp.ones_like, t)


def smooth_field(
    osc: Oscillator, y: State, eps: Array, contacts: Mode | None = None
) -> tuple[Array, ...]:
    """(x1', x2') with tanh(r/eps) in place of sgn(r); with a clock (x1', x2', t').

    A static coefficient above mu(0) plays no part here: the law jumps nowhere. contacts: which
    belts touch; None: those at x1.
    """
    x1, x2, *t = y
    osc = at_time(osc, *t) if t else osc
    force = -x1 - osc.damping * x2
    for push in constant_force(osc):
        force = force + push
    for i, belt in enumerate(osc.belts):
        r = belt.velocity - osc.omega * x2
        if contacts is None:
            touches = (belt.lower < x1) & (x1 < belt.upper)
        else:
            touches = contacts.touching[i]
        friction = belt.load * belt.friction.mu(jnp.abs(r)) * jnp.tanh(r / eps)
        force = force + jnp.where(touches, friction, 0.0)
    return x2, force, *map(jnp.ones_like, t)


@forward_jacobian
def _smoothed_flow(field, osc, width, y, duration, rtol, atol):
    dfx = the_solvers()
    solution = dfx.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: field(osc, y, width)),
        dfx.Tsit5(scan_kind="lax"),
        t0=jnp.zeros_like(duration),
        t1=duration,
        dt0=None,
        y0=y,
        saveat=dfx.SaveAt(t1=True),
        stepsize_controller=dfx.PIDController(rtol=rtol, atol=atol, dtmax=0.5),
        adjoint=dfx.ForwardMode(),
        max_steps=MAX_STEPS_A_SAMPLE,
        throw=False,
    )
    t_end, y = jax.tree.map(lambda leaf: leaf[-1], (solution.ts, solution.ys))
    return jax.tree.map(lambda leaf: jnp.where(t_end >= duration, leaf, jnp.nan), y)


# --- piece by piece between contact edges ---------------------------------------------------------


@functools.cache
def _tsit5() -> Any:
    """Tsit5, which remembers in its state where its last step began and ended, (t, *y) each."""
    dfx = the_solvers()

    class _Remembering(dfx.Tsit5):
        def init(self, terms, t0, t1, y0, args):
            own = super().init(terms, t0, t1, y0, args)
            return own, (t0, *y0), (t0, *y0)

        def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
            own, *_ = solver_state
            y1, *others, own, result = super().step(terms, t0, t1, y0, args, own, made_jump)
            return y1, *others, (own, (t0, *y0), (t1, *y1)), result

    return _Remembering(scan_kind="lax")


class _Tsit5(AbstractIntegrator):
    """Steps of `_tsit5` for the time `span`; scalars.

    The last stage of Tsit5 is at the end of a step, so that it notices a jump of the field there,
    as at the band of the switch model.
    """

    span: Array
    rtol: Array
    atol: Array

    def march(self, field, y, is_outside):
        dfx = the_solvers()

        def ends_outside(t, y, args, **kwargs):
            return (t > 0) & is_outside(y)

        # As the field may jump, only the last step may depend on the span, by where it ends.
        span = lax.stop_gradient(self.span)
        solution = dfx.diffeqsolve(
            dfx.ODETerm(lambda t, y, args: field(y)),
            _tsit5(),
            t0=jnp.zeros_like(span),
            t1=self.span,
            dt0=FIRST_OF_PIECE * span,
            y0=y,
            saveat=dfx.SaveAt(solver_state=True),
            stepsize_controller=dfx.PIDController(
                rtol=self.rtol, atol=self.atol, dtmax=LONGEST_OF_PIECE * span
            ),
            event=dfx.Event(ends_outside),
            adjoint=dfx.ForwardMode(),
            max_steps=MAX_STEPS_A_SAMPLE,
            throw=False,
        )
        state: Any = solution.solver_state
        _, (t_start, *start), (t_end, *end) = state
        hit = jnp.asarray(solution.event_mask)
        finished = hit | (t_end >= self.span)
        return LastStep(t_start, tuple(start), t_end - t_start, tuple(end), hit, finished)


#: Contact codes of a piece, 1 for all belts that touch, then the signs of x2' and x1', [belts + 2].
#: Integers, which have no derivatives.
Codes = Array


def _codes_of(mode: Mode, signs: tuple[Array, ...]) -> Codes:
    codes = [jnp.where(on, 1, code) for on, code in zip(mode.touching, mode.codes, strict=True)]
    return jnp.stack([jnp.asarray(one).astype(int) for one in (*codes, *signs)])


def _signs(rates: State, default: Array) -> tuple[Array, Array]:
    """Signs of x2' and x1'. If x2' = 0, its sign is `default`; if x1' = 0, it gets that of x2'."""
    of_x1, of_x2 = map(jnp.sign, rates[:2])
    of_x2 = jnp.where(of_x2 == 0, default, of_x2)
    return of_x2, jnp.where(of_x1 == 0, of_x2, of_x1)


def _codes_at_start(field: Callable, osc: Oscillator, width: Array, y: State) -> Codes:
    """Contacts and signs at the start; an edge there counts as passed in the motion's direction."""
    now = at_time(osc, *y[2:]) if has_clock(osc) else osc
    right, left = (contact(now, *y[:2], rightward=rightward) for rightward in (True, False))
    one = jnp.ones_like(y[0])
    signs = _signs(field(osc, y, width, right.slipping(1.0)), one)
    return _codes_of(select(signs[1] > 0, right, left), signs)


def _piece(field, osc: Oscillator, width, y: State, codes: Codes, span, rtol, atol):
    """The motion with the contacts of `codes` until it meets an edge, for the time `span` at most.

    Returns its duration, its end, the codes from there on, whether it was ended by an edge or an
    extremum, and whether the integrator failed. It also ends at an extremum of x1 or x2, as in
    `arcs`, so that the sign of the distance to an edge shows whether it was met.
    """
    n, ends = len(osc.belts), Ends(len(osc.belts))
    *contacts, sign_x2, sign_x1 = codes.astype(float)
    mode, signs = Mode(tuple(contacts)), (sign_x2, sign_x1)
    no_boundaries = [jnp.full_like(y[0], jnp.inf)] * n

    def motion(y):
        return field(osc, y, width, mode)

    def guards(*y):
        v, a, *_ = motion(y)
        return jnp.stack(
            [*no_boundaries, *edge_guards(osc, mode, y[0]), signs[0] * a, signs[1] * v]
        )

    # With a clock an extremum may be near however fast the mass is, so every one ends a piece.
    every = has_clock(osc)
    integrator = _Tsit5(span, SAFETY * rtol, SAFETY * atol)
    arc = arc_to_guard(osc, mode, signs, motion, guards, y, integrator, every_extremum=every)
    at_edge = (arc.ended_by >= n) & (arc.ended_by < 3 * n)
    number = jnp.where(at_edge, arc.ended_by - n, 0)
    # One edge at a time: another one at the same place ends a piece of no length, whose derivatives
    # are those of a piece between two edges.
    outside = jnp.where(number < n, BELOW, ABOVE)
    passed = [
        jnp.where(at_edge & (number % n == i), jnp.where(on, outside, 1.0), code)
        for i, (on, code) in enumerate(zip(mode.touching, mode.codes, strict=True))
    ]
    x1 = arc.y[0] + jnp.where(at_edge, lax.stop_gradient(edge_at(osc, number) - arc.y[0]), 0.0)
    end, after = (x1, *arc.y[1:]), Mode(tuple(passed))
    flipped = (
        jnp.where(arc.ended_by == ends.extremum_x2, -signs[0], signs[0]),
        jnp.where(arc.ended_by == ends.extremum_x1, -signs[1], signs[1]),
    )
    rates = field(osc, end, width, after)
    new_signs = _signs(rates, signs[0])[0], signs[1]
    signs = select(at_edge, new_signs, flipped)
    return arc.duration, end, _codes_of(after, signs), arc.ended_by >= 0, arc.failed


@forward_jacobian
def _flow_past_edges(field, osc, width, y, codes, duration, rtol, atol):
    """The state and the codes after a time, NaN where the integrator or the budget gave out."""
    longest = lax.stop_gradient(LONGEST_PIECE / fastest(osc))

    def unfinished(state):
        left, _, _, ended, failed = state
        return (left > 0) & (ended < MAX_ENDED_PIECES) & ~failed

    def advance(state):
        left, y, codes, ended, _ = state
        # A lane of a batch that is done must not keep the others waiting.
        span = jnp.where(unfinished(state), jnp.minimum(left, longest), 0.0)
        passed, y, codes, at_end, failed = _piece(field, osc, width, y, codes, span, rtol, atol)
        is_last = ~at_end & (left <= longest)
        rested = ended - ENDED_PIECES_RATE * fastest(osc) * lax.stop_gradient(passed)
        ended = jnp.maximum(rested, 0.0) + jnp.where(at_end, 1.0, 0.0)
        return jnp.where(is_last, 0.0, left - passed), y, codes, ended, failed

    start = duration, y, codes, jnp.zeros(()), jnp.asarray(False)
    left, y, codes, _, failed = lax.while_loop(unfinished, advance, start)
    reached = (left <= 0) & ~failed
    return jax.tree.map(lambda leaf: jnp.where(reached, leaf, jnp.nan), y), codes


def integrate(field, osc: Oscillator, width: Array, y0, t0, ts, rtol, atol) -> Array:
    """States [n, 2] at the increasing times ts of `field(osc, y, width)` from y0 at t0.

    NaN from where the integrator ran out of steps.
    """
    known = ~jnp.any(jnp.isnan(jnp.stack([*jax.tree.leaves(osc), width])))
    edges = has_edges(osc)

    def advance(carry, t):
        now, y, codes = carry
        # With NaN or inf every step would be rejected, which keeps a batch waiting.
        goes = known & jnp.isfinite(y[0]) & jnp.isfinite(y[1])
        duration = jnp.where(goes, t - now, 0.0)
        if edges:
            y, codes = _flow_past_edges(field, osc, width, y, codes, duration, rtol, atol)
        else:
            y = _smoothed_flow(field, osc, width, y, duration, rtol, atol)
        y = tuple(jnp.where(goes, part, jnp.nan) for part in y)
        return (t, y, codes), jnp.stack(y)

    start = (y0[0], y0[1], t0) if has_clock(osc) else (y0[0], y0[1])
    codes = _codes_at_start(field, osc, width, start) if edges else None
    ys = lax.scan(advance, (t0, start, codes), ts)[1]
    return ys[:, :2] if has_clock(osc) else ys
