"""An oscillator's own units, in which everything is computed.

Time is dimensionless already (tau = omega t), but lengths come in whatever unit the user has. The
public functions bring an oscillator into its own unit of length, compute there, and bring the
results back. So every tolerance is relative to the oscillator's own size, and no answer depends on
the unit. With the unit of length L

    x1 = L x1*,  x2 = L x2*,  nu = omega L nu*,  u0 = L u0*,  mu*(r*) = mu(omega L r*)

and the frequency omega is 1 in own units. L is a power of two, so that a change of unit by a power
of two changes no bit but exponents.

A field of a result that has a dimension says so by `quantity`; `in_given_units` reads that.
"""

import contextlib
import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..checks import is_concrete
from ..dimensions import POWERS
from ..dimensions import quantity as quantity
from .forcing import Oscillating, unchecked
from .oscillator import Belt, NoEdge, Oscillator, has_edges, scaled_edge

#: Where a belt could pull the mass more than HEAVY times as far as the contact edges, these cut the
#: motion off: then edges and velocities give the oscillator's size, not the friction.
HEAVY = 64.0


class OwnUnits(eqx.Module):
    """Units of an oscillator. length: of x1 and x2, a power of two; velocity: of the belts."""

    length: Array
    velocity: Array

    @property
    def is_given(self) -> bool:
        """Whether both units are known to be 1, that is, the user's units."""
        return is_concrete(self) and bool(np.all([self.length, self.velocity] == np.ones(2)))

    def into(self, states: Any) -> Any:
        """States (x1, x2) given in the user's units, in these units."""
        return states if self is _units_of_one() else states / self.length

    def back(self, value: Any, *dimensions: str) -> Any:
        """A value given in these units, in the user's units; dimensions: see `quantity`."""
        return rescaled_quantity(value, self.length, dimensions)


class OwnOscillator(Oscillator):
    """An oscillator in own units; `units` convert between these and the user's."""

    units: OwnUnits = dataclasses.field(kw_only=True)


def own_length(osc: Oscillator) -> Any:
    """The own unit of length: the size of an oscillator, rounded down to a power of two.

    The size is the largest friction force over the stiffness, u0 mus: the mass sticks within that
    distance of the origin. A heavy belt whose contact ends earlier moves the mass no farther than
    to the edge; then edges and velocities determine the size. So they do without friction.
    """

    def number(leaf: Any) -> Any:
        """A leaf without derivatives; known ones as NumPy arrays, which compiles nothing."""
        return np.asarray(leaf) if is_concrete(leaf) else lax.stop_gradient(leaf)

    def largest(wave: Any) -> Any:
        """The largest size of a velocity or a load."""
        if isinstance(wave, Oscillating):
            return abs(number(wave.mean)) + abs(number(wave.amplitude))
        return number(wave)

    loads = [largest(belt.load) for belt in osc.belts]
    pulls = [load * number(belt.friction.static) for load, belt in zip(loads, osc.belts)]
    one: Any = np if is_concrete(pulls) else jnp
    force = functools.reduce(one.maximum, pulls)
    edges = [
        (load, number(edge))
        for load, belt in zip(loads, osc.belts)
        for edge in (belt.lower, belt.upper)
        if not (is_concrete(edge) and np.isinf(edge))
    ]
    size = force
    if edges or not is_concrete(force) or not force > 0:
        one = np if is_concrete(osc) else jnp
        # An edge at 0 gives no length, but it cuts the motion off all the same.
        cuts = [(load > 0) & one.isfinite(edge) for load, edge in edges]
        lengths = [
            one.where(cut, one.abs(edge), 0.0) for cut, (_, edge) in zip(cuts, edges, strict=True)
        ]
        speeds = [
            one.where(load > 0, one.abs(largest(belt.velocity)) / number(osc.omega), 0.0)
            for load, belt in zip(loads, osc.belts)
        ]
        # Inside a trace, known numbers must stay known.
        known = jax.ensure_compile_time_eval() if is_concrete(osc) else contextlib.nullcontext()
        with known:
            pushes = [number(force.bound(osc.damping)) for force in osc.forcing]
        lengths += [one.where(one.isfinite(push), push, 0.0) for push in pushes]
        inner = functools.reduce(one.maximum, [*lengths, *speeds])
        is_cut = functools.reduce(operator.or_, cuts, np.asarray(False))
        is_inner = (is_cut & (HEAVY * inner < force)) | ~(force > 0)
        size = one.where((inner > 0) & is_inner, inner, force)
    return power_of_two_below(size)


#: The bits of the exponent of a float64.
EXPONENT = np.int64(0x7FF0000000000000)


def power_of_two_below(size: Any) -> Any:
    """The largest power of two <= size, by the bits of its exponent; 1 unless size is positive and
    finite."""
    if is_concrete(size):
        size = np.asarray(size, np.float64)
        fine = bool(size > np.finfo(np.float64).tiny) and bool(np.isfinite(size))
        return np.asarray(2.0 ** (np.frexp(size)[1] - 1) if fine else 1.0)
    fine = (size > np.finfo(np.float64).tiny) & jnp.isfinite(size)
    bits = lax.bitcast_convert_type(jnp.where(fine, size, 1.0), jnp.int64)
    return lax.bitcast_convert_type(bits & EXPONENT, jnp.float64)


def in_own_units(osc: Oscillator, unit: Any = None, *, edges: bool | None = None) -> OwnOscillator:
    """The oscillator in its own units, or in those with a given unit of length.

    An oscillator that is in own units already is returned as it is. edges: whether there may be
    contact edges, see `without_edges`; None: what `has_edges` says.
    """
    if isinstance(osc, OwnOscillator):
        return osc
    length: Any = own_length(osc) if unit is None else unit
    known = is_concrete((osc.omega, length))
    omega: Any = np.asarray(osc.omega) if known else osc.omega
    edges = has_edges(osc) if edges is None else edges
    if known and bool(length == 1) and bool(omega == 1):
        own = unchecked(OwnOscillator, **vars(osc), units=_units_of_one())
        return own if edges else without_edges(own)
    velocity = omega * length
    units = _known_units(length, velocity) if known else OwnUnits(jnp.asarray(length), velocity)
    fields = dict(damping=osc.damping, belts=_scaled(osc.belts, units), omega=jnp.ones(()))
    forcing = _scaled_forces(osc.forcing, units)
    own = unchecked(OwnOscillator, **fields, forcing=forcing, units=units)
    return own if edges else without_edges(own)


def in_units_of_run(osc: Oscillator, *, edges: bool | None = None) -> OwnOscillator:
    """The oscillator in own units, for a run whose results go back to the units of `osc`.

    An oscillator that is in own units already gets its results in these: it is returned with units
    of 1. edges: as in `in_own_units`.
    """
    own = in_own_units(osc, edges=edges)
    if own is not osc:
        return own
    return unchecked(OwnOscillator, **vars(own) | dict(units=_units_of_one()))


AnyOscillator = TypeVar("AnyOscillator", bound=Oscillator)
#: The bounds, which are no leaves, of a belt that touches the mass everywhere.
NO_EDGES = dict(lower=NoEdge("-inf"), upper=NoEdge("inf"))


def without_edges(osc: AnyOscillator) -> AnyOscillator:
    """The oscillator with belts that touch the mass everywhere, known so in every trace."""
    if all(isinstance(belt.lower, NoEdge) for belt in osc.belts):
        return osc
    belts = tuple(unchecked(type(belt), **vars(belt) | NO_EDGES) for belt in osc.belts)
    return unchecked(type(osc), **vars(osc) | dict(belts=belts))


def _with_leaves(belts: tuple[Belt, ...]) -> tuple[Belt, ...]:
    """Belts with an array for every bound, as in the user's oscillator."""
    if not any(isinstance(belt.lower, NoEdge) for belt in belts):
        return belts
    with jax.ensure_compile_time_eval():
        bounds = {name: jnp.asarray(np.float64(edge)) for name, edge in NO_EDGES.items()}
    return tuple(
        unchecked(type(belt), **vars(belt) | bounds) if isinstance(belt.lower, NoEdge) else belt
        for belt in belts
    )


def _known_units(length: Any, velocity: Any) -> OwnUnits:
    with jax.ensure_compile_time_eval():
        return OwnUnits(*(jnp.asarray(np.asarray(unit)) for unit in (length, velocity)))


@functools.cache
def _units_of_one() -> OwnUnits:
    """Units of 1; made once, because making a JAX array takes as long as all the rest."""
    return _known_units(1.0, 1.0)


def in_units(value: Any, unit: Any, default: float) -> Any:
    """A size in own units: `value`, given in the user's, or `default` where it is NaN."""
    return jnp.where(jnp.isnan(value), default, value / unit)


def _scaled(belts: tuple[Belt, ...], units: OwnUnits) -> tuple[Belt, ...]:
    return tuple(
        unchecked(
            Belt,
            velocity=in_unit(belt.velocity, units.velocity),
            friction=belt.friction.in_units_of(units.velocity),
            load=in_unit(belt.load, units.length),
            lower=scaled_edge(belt.lower, 1 / units.length),
            upper=scaled_edge(belt.upper, 1 / units.length),
        )
        for belt in belts
    )


def in_unit(wave: Any, unit: Any, time: Any = 1.0) -> Any:
    """A velocity or a load in the given units of its value and, if it oscillates, of time."""
    return wave.in_units_of(unit, time) if isinstance(wave, Oscillating) else wave / unit


def _scaled_forces(forcing: tuple[Any, ...], units: OwnUnits) -> tuple[Any, ...]:
    return tuple(force.in_units_of(units.length, units.length, 1.0) for force in forcing)


# --- results ------------------------------------------------------------------------------------


def in_given_units(result: Any, osc: Oscillator, own: OwnOscillator) -> Any:
    """A result found for `own`, in the units of `osc`, which replaces the oscillators in it."""
    return result if own is osc else rescaled(result, own.units.length, lambda _: osc)


def rescaled(
    result: Any, length: Any, oscillator: Callable[[Oscillator], Oscillator] | None = None
) -> Any:
    """A result with its lengths multiplied by a number, and its oscillators replaced.

    oscillator: function that gives the replacement; None: `in_units_of_user`.
    """
    put = in_units_of_user if oscillator is None else oscillator
    is_one = _is_one(length)

    def walked(value: Any) -> Any:
        if isinstance(value, Oscillator):
            return put(value)
        if isinstance(value, eqx.Module):
            new = {}
            for name, dimensions in _fields_of(type(value)):
                old = vars(value)[name]
                if dimensions is None:
                    changed = walked(old)
                else:
                    changed = old if is_one else rescaled_quantity(old, length, dimensions)
                if changed is not old:
                    new[name] = changed
            return unchecked(type(value), **{**vars(value), **new}) if new else value
        if type(value) in (tuple, list):
            return type(value)(map(walked, value))
        if type(value) is dict:
            return {name: walked(one) for name, one in value.items()}
        return value

    return walked(result)


@functools.cache
def _fields_of(kind: type) -> list[tuple[str, tuple[str, ...] | None]]:
    """Names of a module's fields, each with the dimensions of the field, or None."""
    return [(one.name, one.metadata.get("dimensions")) for one in dataclasses.fields(kind)]


def _is_one(length: Any) -> bool:
    if length is _units_of_one().length:
        return True
    return is_concrete(length) and bool(np.all(np.asarray(length) == 1))


def rescaled_quantity(value: Any, length: Any, dimensions: tuple[str, ...]) -> Any:
    """A quantity with these dimensions when the numbers of lengths are multiplied by `length`."""
    powers = [POWERS[name] for name in dimensions]
    if value is None or _is_one(length) or not any(powers):
        return value
    factors = [length**power for power in powers]
    if isinstance(value, float):
        return value * float(factors[0])
    one: Any = np if isinstance(value, np.ndarray) else jnp
    columns = one.stack([one.asarray(factor) for factor in factors])
    many = (1,) * (one.ndim(value) - 1) + (-1,)
    return value * (one.reshape(columns, many) if len(factors) > 1 else columns[0])


def in_units_of_user(own: Oscillator) -> Oscillator:
    """The oscillator in the user's units, up to rounding if omega is no power of two."""
    if not isinstance(own, OwnOscillator):
        return own
    units = own.units
    if units.is_given:
        fields = {name: value for name, value in vars(own).items() if name != "units"}
        return unchecked(Oscillator, **fields | dict(belts=_with_leaves(own.belts)))
    back = OwnUnits(1 / units.length, 1 / units.velocity)
    belts, forcing = _scaled(_with_leaves(own.belts), back), _scaled_forces(own.forcing, back)
    omega = units.velocity / units.length
    fields = dict(damping=own.damping, belts=belts, omega=omega, forcing=forcing)
    return unchecked(Oscillator, **fields)
