"""Nonsmooth folds in the switch model: why published ones differ from the exact ones.

The paper finds its folds by simulation of a switch model, eqs. (21)-(23): around the boundary of
belt k lies a band |r| <= v_star. Within it the contact holds, x1' = nu_k/omega and r decays like
exp(-t), until the needed force exceeds the capacity. So the mass is released not at r = 0 but at r
= v_star exp(-tau), tau the time in the band, and does not come back quite as far as it would from r
= 0. The cycle is lost too early, by about (m - 1) v_star over the speed at which the gap opens, m
the multiplier of the cycle that it meets.

The cycle is lost like this: the later the orbit enters the band, the less time is left for r to
decay, and the later it enters in the next loop. So the cycle that sticks meets another one that
sticks, in a smooth fold. The unknowns of such a cycle are (g, tau, T), g the distance in x1 of the
entry before the point of x2' = 0, T the duration of slip. There are three equations: slip onset at
the end of the band, and the orbit from there comes back to the entry (x1, x2). At the fold their
Jacobian is singular; that is the fourth equation, for the fourth unknown, a parameter of the
oscillator or v_star itself. As v_star goes to zero, g/v_star goes to m.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from jaxbelt.bifurcations.base import BifurcationPoint
from jaxbelt.bifurcations.systems import small_newton
from jaxbelt.bifurcations.tangencies import NonsmoothFold
from jaxbelt.checks import as_array, check_positive, require
from jaxbelt.cycles.shooting import flow
from jaxbelt.model.modes import Mode, capacity, mode_acceleration
from jaxbelt.model.oscillator import Oscillator
from jaxbelt.model.parameters import leaf_index, vary

#: Integration steps of order twelve for the slip phase: with half as many folds move by 2e-12, with
#: twice as many by 5e-15.
SLIP_STEPS = 64
#: v_star of the first solution, and the number of solutions from it to the given v_star: so v_star
#: up to 1e-2 is reached; with three solutions, or from 1e-8, up to 1e-3.
FIRST, STAGES = 1e-6, 4
#: The v_star from which the search for the band of a given fold starts.
TYPICAL = 1e-4


class SwitchFold(eqx.Module):
    """A nonsmooth fold of the switch model; NaN where Newton's method found none.

    value: of the parameter; v_star: half-width of the band; residual: largest error in the
    equations.
    """

    value: Array
    v_star: Array
    residual: Array


def switch_fold(
    point: BifurcationPoint, v_star: ArrayLike, *, where: Callable[[Oscillator], Any]
) -> SwitchFold:
    """The fold in the switch model with a band of half-width v_star > 0.

    `value` is differentiable with respect to v_star.

    Args:
        point: The exact fold, from `refine(NonsmoothFold(belt), ...)`, with one stick phase and one
            slip mode.
        v_star: Half-width of the band.
        where: Selects the parameter of the point, as for `refine`.

    Returns:
        The `SwitchFold`.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """
    _check(point)
    v_star = as_array(v_star, "v_star")
    check_positive(v_star, "v_star")
    return _fold(point, leaf_index(point.oscillator, where), v_star)


def switch_band(
    point: BifurcationPoint, value: ArrayLike, *, where: Callable[[Oscillator], Any]
) -> SwitchFold:
    """The half-width v_star of the band that puts the fold at `value`; otherwise like
    `switch_fold`."""
    _check(point)
    return _band(point, leaf_index(point.oscillator, where), as_array(value, "value"))


def _check(point):
    require(
        isinstance(point, BifurcationPoint) and isinstance(point.condition, NonsmoothFold),
        "point",
        "a nonsmooth fold from refine",
        repr(point),
    )
    codes = np.asarray(point.cycle.chain.codes)[np.asarray(point.cycle.chain.used)]
    slips = codes[np.all(codes != 0, axis=-1)]
    require(
        len(slips) > 0 and np.all(slips == slips[0]) and len(codes) == len(slips) + 1,
        "point",
        "a fold of a cycle with one stick phase and one slip mode",
        repr(point.cycle),
    )


@eqx.filter_jit
def _fold(point, index, v_star):
    # From a narrow band, where the asymptotic solution is good, by equal factors to the given one.
    bands = FIRST * (v_star / FIRST) ** jnp.linspace(0.0, 1.0, STAGES)

    def equations(given, u):
        point, v_star = given
        return _equations(point, index, u, u[3], v_star)

    def stage(u, v_star):
        u, _, residual, _ = small_newton(equations, (point, v_star), u)
        return u, residual

    start = jnp.append(jnp.array([1.0, 1.0, 1.0]), point.value)
    u, residuals = lax.scan(stage, lax.stop_gradient(start), bands)
    return _where_found(u[3], v_star, residuals[-1])


@eqx.filter_jit
def _band(point, index, value):
    def equations(given, u):
        point, value = given
        return _equations(point, index, u, value, jnp.exp(u[3]))

    start = jnp.append(jnp.array([1.0, 1.0, 1.0]), jnp.log(TYPICAL))
    u, _, residual, _ = small_newton(equations, (point, value), start)
    return _where_found(value, jnp.exp(u[3]), residual)


def _where_found(value, v_star, residual) -> SwitchFold:
    residual = residual * v_star  # the equations are in units of v_star
    found = residual < 1e-12
    value, v_star, residual = (
        jnp.where(found, number, jnp.nan) for number in (value, v_star, residual)
    )
    return SwitchFold(value, v_star, residual)


def _equations(point, index: int, u: Array, value: Array, v_star: Array) -> Array:
    """Four equations for (g, tau, T), in units of their limits for small v_star, and the fourth
    unknown; u: (g, tau, T) in these units first.

    As v_star goes to zero g goes to m v_star. The mass covers in the band the distance g in x1 and,
    from there, that in which the needed force grows from u0 mu(v_star) to u0 mus.
    """
    point = lax.stop_gradient(point)
    belt = point.oscillator.belts[point.condition.belt]
    _, slope = jax.jvp(belt.friction.mu, (jnp.zeros(()),), (jnp.ones(()),))
    way = point.multiplier - belt.load * slope
    tau = way * point.oscillator.omega / jnp.abs(belt.velocity)
    units = jnp.stack([v_star * point.multiplier, v_star * tau, point.cycle.period])
    osc = vary(point.oscillator, index, value[None])

    def cycle(u):
        return _cycle_equations(point, osc, v_star, units * u) / v_star

    return jnp.append(cycle(u[:3]), v_star * jnp.linalg.det(jax.jacfwd(cycle)(u[:3])))


def _cycle_equations(point, osc: Oscillator, v_star: Array, unknowns: Array) -> Array:
    """Errors of the three equations of a cycle: in the force, in x1 and in x2, [3].

    The needed force is at its limit at the end of the band, and the slip phase, followed backwards
    from the entry into the band, begins at that end.
    """
    gap, tau, duration = unknowns
    k = point.condition.belt
    slip = point.cycle.chain.codes[0]
    codes = [slip[i] for i in range(slip.size)]
    mode = Mode(tuple(codes))
    held = Mode((*codes[:k], jnp.zeros(()), *codes[k + 1 :]))
    nu = osc.belts[k].velocity
    sign = jnp.sign(nu)
    x2 = (nu - sign * v_star) / osc.omega
    x1 = mode_acceleration(osc, mode, jnp.zeros(()), x2) - sign * gap
    x1_end = x1 + nu / osc.omega * tau
    x2_end = (nu - sign * v_star * jnp.exp(-tau)) / osc.omega
    onset = mode_acceleration(osc, held, x1_end, x2_end) + sign * capacity(osc, held)
    mesh = jnp.full(SLIP_STEPS, 1 / SLIP_STEPS)
    start = flow(osc, slip, mesh, jnp.stack([x1, x2]), -duration)
    return jnp.stack([onset, start[0] - x1_end, start[1] - x2_end])
