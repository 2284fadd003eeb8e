"""`Family`: oscillators that are linear in one or two parameters, as data for compiled programs."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer

from ..checks import is_concrete
from .oscillator import (
    Oscillator,
)


class Family(NamedTuple):
    """Oscillators that are linear in one or two parameters, as data for compiled programs.

    oscillator: the one at the parameters `origin`, [k]; slopes: derivative of each of its leaves by
    the parameters, [k, ...], None where a leaf is no number.
    """

    oscillator: Oscillator
    slopes: tuple[Any, ...]
    origin: Any

    def at(self, p: Any) -> Oscillator:
        """The oscillator at the parameters p, [k]."""
        leaves, structure = jax.tree.flatten(self.oscillator)
        known = is_concrete((self, p))
        # Known arrays are split by NumPy, which compiles nothing.
        one: Any = np if known else jnp
        shift = one.asarray(p) - one.asarray(self.origin)
        for place, (leaf, slope) in enumerate(zip(leaves, self.slopes, strict=True)):
            if slope is None or not (isinstance(slope, Tracer) or np.any(slope)):
                continue
            # An edge may be infinite, and a parameter NaN: leaves of slope 0 must stay as they are.
            moves = [
                one.where(row == 0, 0.0, row * by) for row, by in zip(slope, shift, strict=True)
            ]
            leaves[place] = jnp.asarray(sum(moves, start=one.asarray(leaf)))
        return jax.tree.unflatten(structure, leaves)

    def rows(self, values: np.ndarray) -> Oscillator:
        """As `at`, for many known values [rows, k]: one oscillator whose leaves have a row each."""
        leaves, structure = jax.tree.flatten(self.oscillator)
        shifts = (values - np.asarray(self.origin)).T
        for place, (leaf, slope) in enumerate(zip(leaves, self.slopes, strict=True)):
            if not eqx.is_array(leaf):
                continue
            made = np.broadcast_to(np.asarray(leaf), (len(values), *leaf.shape))
            if slope is not None and np.any(slope):
                columns = shifts.reshape(*shifts.shape, *(1,) * leaf.ndim)
                pairs = zip(np.asarray(slope), columns, strict=True)
                made = sum((np.where(row == 0, 0.0, row * by) for row, by in pairs), start=made)
            leaves[place] = jnp.asarray(made)
        return jax.tree.unflatten(structure, leaves)

    @property
    def units(self) -> Any:
        """Natural unit of each parameter, [k]: the step that changes the most sensitive number of
        the oscillator by 1. Steps in it do not depend on the units in which parameters are given.
        """
        slopes = [slope for slope in lax.stop_gradient(self.slopes) if slope is not None]
        one: Any = np if is_concrete(slopes) else jnp
        rows = [one.abs(one.reshape(slope, (len(slope), -1))) for slope in slopes]
        rates = one.max(one.concatenate(rows, axis=1), axis=1)
        return one.where(rates > 0, 1 / one.where(rates > 0, rates, 1.0), 1.0)

    @property
    def unit(self) -> Any:
        """Natural unit of the last parameter, see `units`."""
        return self.units[-1]

    def belt_slopes(self, belt: int, name: str) -> Any:
        """Slopes by the parameters, [k], of the number `name` of a belt, such as "velocity"."""
        slopes = jax.tree.unflatten(jax.tree.structure(self.oscillator), self.slopes)
        return getattr(slopes.belts[belt], name)

    def zeros(self, which: Sequence[tuple[int, str]]) -> list[float]:
        """Values of the only parameter at which a number (belt, name) of a belt is zero, or two of
        them are equal: one value, or none if that number or difference is constant."""
        at = [*(float(getattr(self.oscillator.belts[belt], name)) for belt, name in which), 0.0]
        along = [*(float(self.belt_slopes(belt, name)[0]) for belt, name in which), 0.0]
        if along[0] == along[1]:
            return []
        return [float(self.origin[0]) + (at[1] - at[0]) / (along[0] - along[1])]
