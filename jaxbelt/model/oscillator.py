"""The belt-driven oscillator: a mass on a spring and a dashpot, dragged by rough belts.

State y = (x1, x2), displacement and velocity, in the dimensionless time tau = omega t, eq. (6):

    x1' = x2
    x2' = -x1 - zeta x2 + sum over touching belts of  u0_i mu_i(|r_i|) sgn(r_i)

with the relative velocity r_i = nu_i - omega x2 of belt i; forces on the mass, and belts whose
velocity or load oscillates, stand in `forcing`. The paper's symbols, and ours:

| symbol | here | meaning |
|---|---|---|
| zeta | `Oscillator.damping` | c / sqrt(k m) |
| omega | `Oscillator.omega` | sqrt(k/m), ties belt velocities to the dimensionless time |
| nu_i | `Belt.velocity` | driving velocity of belt i |
| u0_i | `Belt.load` | normal force over stiffness, Fn/k |
| sigma0, sigma1 | `Belt.lower`, `Belt.upper` | interval of x1 in which a belt touches |
| mus, p1, p2, p3 | `Conti.static, residual, quadratic, steepness` | eqs. (7), (16) |

What happens where the field is not smooth is defined in `modes`.

An oscillator with a clock, see `has_clock`, has no field of (x1, x2) alone. At an instant it equals
an oscillator without a clock, with a constant force and belts of constant velocity and load:
`at_time` returns that one, and all code that needs forces, guards or modes at an instant takes it.
"""

import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ..checks import (
    KnownNames,
    Rule,
    as_array,
    be_finite,
    be_nonnegative,
    be_positive,
    in_words,
    is_concrete,
    number,
    require,
    require_own_threads,
    require_value,
    scalar,
)
from ..dimensions import quantity
from ..numerics.compiling import traced_once
from .forcing import (
    AbstractForce,
    ConstantForce,
    Oscillating,
    as_forcing,
    as_load,
    as_velocity,
    rate_of_repeats,
    unchecked,
)
from .friction import AbstractFriction, as_friction

#: Largest number of periods of the slowest wave in a common period of all waves.
RATIOS = 64
#: Relative rounding of a ratio of two frequencies.
RATIO_ROUNDING = 1e-14


@jax.custom_jvp
def _as_it_is(edge: Array) -> Array:
    return edge


@_as_it_is.defjvp
def _(primals, tangents):
    (edge,), (tangent,) = primals, tangents
    return edge, jnp.where(jnp.isinf(edge), 0.0, tangent)


def as_edge(field: str) -> Callable[[Any], Array]:
    """Converter of a field that is the edge of a contact interval."""
    return lambda value: _as_edge(value, field)


def _as_edge(value: Any, field: str) -> Array:
    """`value` as the edge of a contact interval, or a `ValueError`.

    An edge at infinity has no effect on the motion, so its slope is 0; that of inf/L is infinite.
    """
    edge = as_array(value, field)
    if not isinstance(edge, Tracer):
        return edge
    try:
        # Under derivatives without `jit` the value is known: then infinity becomes a constant.
        at_infinity = next((end for end in (-np.inf, np.inf) if bool(edge == end)), None)
    except jax.errors.ConcretizationTypeError:
        return _as_it_is(edge)
    return edge if at_infinity is None else as_array(at_infinity, field)


class NoEdge(float):
    """An edge at infinity that is part of the structure of an oscillator.

    It works as a number everywhere, but is no leaf: so every trace knows it and leaves out the code
    for edges.
    """


jax.tree_util.register_pytree_node(NoEdge, lambda edge: ((), float(edge)), lambda at, _: NoEdge(at))


def scaled_edge(edge: Any, factor: ArrayLike) -> Any:
    """An edge in another unit, without a slope where it is at infinity, also in reverse mode."""
    if is_concrete(edge):
        return edge if np.isinf(edge) else edge * factor
    is_edge = jnp.isfinite(edge)
    return jnp.where(is_edge, jnp.where(is_edge, edge, 0.0) * factor, edge)


class Belt(KnownNames):
    """A rough belt that moves at a given velocity and touches the mass while lower < x1 < upper.

    All numbers are dimensionless scalars.

    Args:
        velocity: nu, a number or `Oscillating`.
        friction: Friction law.
        load: Normal force over stiffness, u0 = Fn/k >= 0, a number or `Oscillating`; default 1.
        lower: Lower edge of the contact interval; default unbounded. An edge at infinity has no
            derivative. Write it `jnp.inf`: the reverse derivative of `jnp.inf / L` by L is NaN
            under `jit`, in JAX.
        upper: Upper edge, likewise.

    Raises:
        ValueError: If a value is not finite, negative or of the wrong shape, or if the interval is
            reversed.
    """

    # A scalar array or an `Oscillating`.
    velocity: Any = eqx.field(converter=as_velocity, metadata=quantity("velocity"))
    friction: AbstractFriction = eqx.field(converter=as_friction)
    load: Any = eqx.field(converter=as_load, default=1.0, metadata=quantity("force"))
    lower: Float[Array, ""] = eqx.field(
        converter=as_edge("lower"), default=-float("inf"), metadata=quantity("length")
    )
    upper: Float[Array, ""] = eqx.field(
        converter=as_edge("upper"), default=float("inf"), metadata=quantity("length")
    )

    def __check_init__(self):
        self.check("belt")

    def check(self, owner: str) -> None:
        """Raises a `ValueError` naming `owner` if a known parameter is out of range."""
        for rule in self.rules():
            rule.enforce(f" of {owner}")

    def rules(self) -> list[Rule]:
        """Conditions on its parameters, those of its law included."""
        law = type(self.friction).rules(self.friction)
        interval = [
            Rule("lower", (self.lower, self.lower), operator.eq, "a number"),
            Rule("upper", (self.upper, self.upper), operator.eq, "a number"),
            Rule("lower", (self.lower, self.upper), operator.lt, "< upper = {1}"),
        ]
        return [
            *_rules_of(self.velocity, "velocity", be_finite),
            *_rules_of(self.load, "load", be_nonnegative),
            *(rule._replace(field=f"{rule.field} of friction") for rule in law),
            *(interval if not isinstance(self.lower, NoEdge) else []),
        ]

    def __repr__(self) -> str:
        velocity, load = map(number_or_wave, (self.velocity, self.load))
        return (
            f"Belt(velocity={velocity}, friction={self.friction!r}, "
            f"load={load}, lower={number(self.lower)}, upper={number(self.upper)})"
        )


def _rules_of(value: Any, field: str, rules: Any) -> list[Rule]:
    return value.rules_as(field) if isinstance(value, Oscillating) else rules(field, value)


def number_or_wave(value: Any) -> str:
    """A velocity or a load as a text, see `number`."""
    return repr(value) if isinstance(value, Oscillating) else number(value)


class MovingBelt(Belt):
    """A belt of oscillating velocity at an instant; rate: the time derivative of its velocity."""

    rate: Array = eqx.field(kw_only=True)


def as_belts(belts: Any, kind: str = "Belt") -> tuple:
    """The belts as a tuple; kind: name of their class, for messages."""
    expected = f"a tuple of belts, such as (jb.{kind}(...), jb.{kind}(...))"
    fits = isinstance(belts, Iterable) and not isinstance(belts, str | dict)
    require_value(fits, "belts", expected, belts)
    return tuple(belts)


def _in_numpy(leaf: Any) -> Any:
    return np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf


class Oscillator(KnownNames):
    """A mass on a spring and a dashpot, in contact with one belt or more.

    For batches build it inside `jax.vmap`. A negative damping is possible; starts far out may then
    go to infinity, see `portrait(osc).escapes`. All numbers are dimensionless scalars.

    Args:
        damping: zeta = c/sqrt(k m).
        belts: One `Belt` or more.
        omega: sqrt(k/m) > 0, default 1: the unit of time of the belts' velocities.
        forcing: A force on the mass such as `Harmonic`, or a tuple of forces; default none.

    Raises:
        ValueError: If a value is impossible; the message names it.
    """

    damping: Float[Array, ""] = eqx.field(converter=scalar("damping"), metadata=quantity("damping"))
    belts: tuple[Belt, ...] = eqx.field(converter=as_belts)
    omega: Float[Array, ""] = eqx.field(converter=scalar("omega"), default=1.0)
    forcing: tuple[AbstractForce, ...] = eqx.field(converter=as_forcing, default=())

    def __check_init__(self):
        self.check()

    def check(self) -> None:
        """Raises a `ValueError` that names the first field with an impossible known value."""
        # Known values become NumPy arrays: reading a JAX array costs a hundred times more. Checks
        # are called through their class, as Equinox makes a module of a bound method. A user's law
        # may have Python numbers, too.
        osc = jax.tree.map(_in_numpy, self) if is_concrete(self) else self
        for rule in Oscillator.rules(osc):
            rule.enforce("")
        require(len(osc.belts) > 0, "belts", "at least one Belt", "none")
        for i, belt in enumerate(osc.belts):
            if not isinstance(belt, Belt):
                # A machine's belts are in SI units, and its oscillator's are not.
                is_physical = type(belt).__name__ == "PhysicalBelt"
                hint = "; the Oscillator of a Machine is machine.oscillator" * is_physical
                require(False, f"belts[{i}]", "a Belt", in_words(belt) + hint)
            Belt.check(belt, f"belt {i}")
        for i, force in enumerate(osc.forcing):
            AbstractForce.check(force, f"forcing[{i}]")

    def rules(self) -> list[Rule]:
        """Conditions on its parameters, without those of its belts."""
        return be_finite("damping", self.damping) + be_positive("omega", self.omega)

    def __repr__(self) -> str:
        belts = ", ".join(map(repr, self.belts))
        damping, omega = number(self.damping), number(self.omega)
        forces = ", ".join(map(repr, self.forcing))
        forcing = f", forcing=({forces},)" if self.forcing else ""
        return f"Oscillator(damping={damping}, belts=({belts},), omega={omega}{forcing})"


def has_clock(osc: Oscillator) -> bool:
    """Whether a force, velocity or load varies in time; known from the structure, in traces too."""
    forced = any(not isinstance(force, ConstantForce) for force in osc.forcing)
    waves = [wave for belt in osc.belts for wave in (belt.velocity, belt.load)]
    return forced or any(isinstance(wave, Oscillating) for wave in waves)


def refuse_clock(osc: Any, name: str, instead: str = "") -> None:
    """Raises if an oscillator has a clock but `name`, a function, takes only those without one.

    instead: what else to use, such as "jb.sweep(...)".
    """
    if isinstance(osc, Oscillator) and has_clock(osc):
        hint = f"; use {instead}" if instead else ""
        expected = f"without a clock: {name} is for oscillators that do not know the time{hint}"
        require(False, "osc", expected, "one with forcing")


def check_clock(osc: Any, name: str, instead: str) -> None:
    """Raises if an oscillator has no clock but `name`, a function, takes only those with one.

    instead: what else to use, such as "jb.find_cycle".
    """
    if isinstance(osc, Oscillator) and not has_clock(osc):
        expected = f"with a clock: {name} is for oscillators that are forced; use {instead}"
        require(False, "osc", expected, "one without forcing")


def waves_of(osc: Oscillator) -> list[Any]:
    """All that depends on the time: forces, then oscillating velocities and loads of the belts."""
    forces = [one for one in osc.forcing if not isinstance(one, ConstantForce)]
    waves = [wave for belt in osc.belts for wave in (belt.velocity, belt.load)]
    return forces + [wave for wave in waves if isinstance(wave, Oscillating)]


def frequencies(osc: Oscillator) -> list[Array]:
    """Angular frequencies of the `waves_of` an oscillator, in the same order."""
    return [wave.frequency for wave in waves_of(osc)]


def clock_frequency(osc: Oscillator) -> Array:
    """Frequency by which periods are counted: the first of `frequencies` that is not 0."""
    return _first_not_zero(frequencies(osc))


def _first_not_zero(numbers: Sequence[Any], xp: Any = jnp) -> Any:
    return functools.reduce(lambda after, one: xp.where(one == 0, after, one), reversed(numbers))


def repeating(osc: Oscillator) -> list[Array]:
    """The `rate_of_repeats` of each of the `waves_of` an oscillator; see `common_turns`."""
    return [rate_of_repeats(wave) for wave in waves_of(osc)]


def common_turns(rates: Sequence[Any], xp: Any = jnp) -> Any:
    """Number of periods of the clock in the common period of all waves; 0 if there is none within
    `RATIOS`. rates: the `repeating` rates, arrays of one shape, of NumPy or JAX as `xp` says.

    A constant wave, with the rate 0, repeats with any period.
    """
    found = [xp.abs(one) for one in rates]
    slowest = functools.reduce(xp.minimum, [xp.where(one == 0, xp.inf, one) for one in found])
    ratios = [one / slowest for one in found]
    count = xp.arange(1, RATIOS + 1, dtype=slowest.dtype).reshape((1,) * slowest.ndim + (RATIOS,))
    whole = xp.ones((*slowest.shape, RATIOS), bool)
    for ratio in ratios:
        passed = count * ratio[..., None]
        whole = whole & (xp.abs(passed - xp.round(passed)) <= RATIO_ROUNDING * passed)
    first = (1 + xp.argmax(whole, axis=-1)).astype(slowest.dtype)
    turns = xp.round(first * _first_not_zero(ratios, xp))
    return xp.where(xp.any(whole, axis=-1), turns, 0.0)


def fastest(osc: Oscillator) -> Array:
    """The highest frequency of all that depends on the time, at least 1, the natural frequency."""
    forces = [one.fastest for one in osc.forcing if not isinstance(one, ConstantForce)]
    waves = frequencies(osc)[len(forces) :]
    return functools.reduce(jnp.maximum, map(jnp.abs, forces + waves), jnp.ones(()))


def wave_at(wave: Any, t: Array) -> Any:
    """Value at the time t of a velocity or a load, constant or oscillating."""
    return wave.value(t) if isinstance(wave, Oscillating) else wave


def at_time(osc: Oscillator, t: Array) -> Oscillator:
    """The oscillator without a clock that equals `osc` at the time t; `osc` if it has no clock.

    Its forces are constant and its belts have the velocity and load of that time; belts whose
    velocity oscillates become `MovingBelt`s. Derivatives by t are those of these numbers.
    """
    if not has_clock(osc):
        return osc
    total = functools.reduce(
        operator.add, [force.on_mass(t, osc.damping) for force in osc.forcing], jnp.zeros_like(t)
    )
    force = unchecked(ConstantForce, amplitude=total, phase=None)
    belts = tuple(_belt_at(belt, t) for belt in osc.belts)
    fields = dict(damping=osc.damping, belts=belts, omega=osc.omega, forcing=(force,))
    return unchecked(Oscillator, **fields)


def _belt_at(belt: Belt, t: Array) -> Belt:
    moves = isinstance(belt.velocity, Oscillating)
    fields = vars(belt) | dict(velocity=wave_at(belt.velocity, t), load=wave_at(belt.load, t))
    if moves:
        fields["rate"] = belt.velocity.rate(t)
    return unchecked(MovingBelt if moves else Belt, **fields)


def constant_force(osc: Oscillator) -> list[Array]:
    """The values of the constant forces on the mass; a `TypeError` if a force has a clock."""
    if not all(isinstance(force, ConstantForce) for force in osc.forcing):
        raise TypeError("the forces of an oscillator with a clock are those of `at_time`")
    return [force.push for force in osc.forcing if isinstance(force, ConstantForce)]


def check_oscillator(osc: Any, field: str = "osc") -> None:
    """Raises a `ValueError` unless `osc` is one oscillator whose known values are all possible.

    Public functions call this first; in a forked process it raises a `RuntimeError`.
    """
    require_own_threads()
    if not isinstance(osc, Oscillator):
        expected = "an Oscillator, such as jb.presets.class_b(...)"
        require(False, field, expected, in_words(osc) + its_oscillator(osc))
    check_scalars(osc)
    Oscillator.check(osc)


def its_oscillator(value: Any, verb: str = "give") -> str:
    """Hint, for a message, to give the oscillator of a value that has one, such as a `Machine`."""
    has = isinstance(value, eqx.Module) and "oscillator" in dir(value)
    return f"; {verb} {type(value).__name__.lower()}.oscillator" if has else ""


def check_scalars(osc: Oscillator) -> None:
    """Raises a `ValueError` if a parameter is batched, for which `jax.vmap` is the right tool."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(osc):
        if eqx.is_inexact_array(leaf) and (leaf.ndim > 0 or leaf.dtype != jnp.float64):
            as_array(leaf, jax.tree_util.keystr(path, simple=True, separator="."))


def has_possible_numbers(osc: Oscillator) -> Array:
    """Whether all parameters are possible: the conditions of `check`, as a boolean scalar.

    Under `jit` and `vmap` nothing raises: a run of an impossible oscillator is NOT_FINITE.
    """
    rules = Oscillator.rules(osc) + [rule for belt in osc.belts for rule in Belt.rules(belt)]
    rules += [rule for force in osc.forcing for rule in type(force).rules(force)]
    return functools.reduce(operator.and_, (jnp.asarray(rule.holds()) for rule in rules))


def interval_ends(osc: Oscillator) -> list[Any]:
    """The lower ends of all contact intervals, then the upper ones."""
    return [belt.lower for belt in osc.belts] + [belt.upper for belt in osc.belts]


def has_edges(osc: Oscillator) -> bool:
    """Whether there may be a contact edge: one is finite, or not known to be infinite.

    Constant bounds are known inside a trace, too; the code that edges need is then left out.
    """
    bounds = [bound for bound in interval_ends(osc) if not isinstance(bound, NoEdge)]
    return not is_concrete(bounds) or bool(np.any(np.isfinite(bounds)))


@traced_once
def acceleration(osc: Oscillator, signs: tuple[Array, ...], x1: Array, x2: Array) -> Array:
    """x2' where belt i slips with the fixed sign signs[i] = +1 or -1 of r_i, or does not count (0).

    Eqs. (3), (4), (12)-(14) of the paper for any number of belts, smooth across the boundaries
    because the signs are given. Arrays may carry any common batch shape. With the sign of a stuck
    belt 0 this is the force that the stuck contact has to hold.
    """
    force = -x1 - osc.damping * x2
    for push in constant_force(osc):
        force = force + push
    for belt, sign in zip(osc.belts, signs, strict=True):
        speed = belt.velocity - osc.omega * x2
        speed = jnp.where(sign == 0, jnp.abs(speed), sign * speed)
        force = force + sign * (belt.load * belt.friction.mu(speed))
    return force
