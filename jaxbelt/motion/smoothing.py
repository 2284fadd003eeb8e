"""Two approximations of the exact motion in common use: the switch model and tanh smoothing.

`switch_field` is the paper's switch model, eqs. (21)-(23): around each boundary lies a band
|r_k| <= v_star in which a contact that can hold moves with the belt, while x2 relaxes to the belt's
velocity. `smooth_field` replaces sgn(r) by tanh(r/eps), so that nothing ever sticks: the mass
creeps. Both are plain vector fields of the state, integrated without events; as v_star and eps go
to zero they approach the exact motion at first order. The switch field is discontinuous, and
derivatives through its integration lack the jumps at the band: take them from the exact one.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..model.modes import (
    STUCK,
    Mode,
    capacity,
    mode_acceleration,
    select,
    stick_rate,
    stick_velocity,
)
from ..model.oscillator import Oscillator, at_time, constant_force, has_clock
from ..model.transitions import contact
from ..numerics.compiling import the_solvers
from ..numerics.derivatives import forward_jacobian

#: Steps between two samples before a run is given up.
MAX_STEPS_A_SAMPLE = 1_000_000


def switch_mode(osc: Oscillator, x1: Array, x2: Array, v_star: Array) -> Mode:
    """The mode of the switch model at a state: belts of the band that holds have code 0.

    Where the bands of two belts overlap, the first belt that can hold wins; belts of one velocity
    hold together.
    """
    slip = contact(osc, x1, x2, rightward=True)
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


def switch_field(osc: Oscillator, y: tuple[Array, ...], v_star: Array) -> tuple[Array, ...]:
    """(x1', x2') of the switch model, eqs. (21)-(23) of the paper; with a clock (x1', x2', t')."""
    x1, x2, *t = y
    osc = at_time(osc, *t) if t else osc
    mode = switch_mode(osc, x1, x2, v_star)
    velocity = stick_velocity(osc, mode, osc.omega * x2)
    x1_dot = velocity / osc.omega
    x2_dot = (velocity - osc.omega * x2) / osc.omega
    if t:
        x2_dot = x2_dot + stick_rate(osc, mode) / osc.omega
    x2_dot = jnp.where(mode.any_stuck, x2_dot, mode_acceleration(osc, mode, x1, x2))
    return x1_dot, x2_dot, *map(jnp.ones_like, t)


def smooth_field(osc: Oscillator, y: tuple[Array, ...], eps: Array) -> tuple[Array, ...]:
    """(x1', x2') with tanh(r/eps) in place of sgn(r); with a clock (x1', x2', t').

    A static coefficient above mu(0) plays no part here: the law jumps nowhere.
    """
    x1, x2, *t = y
    osc = at_time(osc, *t) if t else osc
    force = -x1 - osc.damping * x2
    for push in constant_force(osc):
        force = force + push
    for belt in osc.belts:
        r = belt.velocity - osc.omega * x2
        touches = (belt.lower < x1) & (x1 < belt.upper)
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


def integrate(field, osc: Oscillator, width: Array, y0, t0, ts, rtol, atol) -> Array:
    """States [n, 2] at the increasing times ts of `field(osc, y, width)` from y0 at t0.

    NaN from where the integrator ran out of steps.
    """
    known = ~jnp.any(jnp.isnan(jnp.stack([*jax.tree.leaves(osc), width])))

    def advance(carry, t):
        now, y = carry
        # What is not a number would reject every step, and keep a batch waiting.
        goes = known & jnp.isfinite(y[0]) & jnp.isfinite(y[1])
        y = _smoothed_flow(field, osc, width, y, jnp.where(goes, t - now, 0.0), rtol, atol)
        y = tuple(jnp.where(goes, part, jnp.nan) for part in y)
        return (t, y), jnp.stack(y)

    start = (y0[0], y0[1], t0) if has_clock(osc) else (y0[0], y0[1])
    ys = lax.scan(advance, (t0, start), ts)[1]
    return ys[:, :2] if has_clock(osc) else ys
