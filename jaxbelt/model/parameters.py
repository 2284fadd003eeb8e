"""Parameters of an oscillator: leaves, identified by their places.

Two parameters may have one value, and two belts may share one friction law; parameters
differ in their place among the leaves of the oscillator, as JAX counts them. So `where` is called
on a copy of the oscillator whose leaves are unique objects: if its result is none of these, it has
not selected a parameter.

The fields of an oscillator state the dimensions of its parameters; the unit of a number of a
friction law follows from its `in_units_of`.
"""

import re
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks import is_concrete, require, require_callable
from .friction import LawInUnits
from .machine import SI_UNITS, Units
from .oscillator import Oscillator

#: Relative accuracy with which a number of a law must scale as a power of the unit of speed.
POWER_ROUNDING = 1e-12


class Parameter:
    """Placeholder of a leaf while `where` selects; without a value, so nothing computes with it."""

    def __init__(self, index: int, name: str):
        self.index, self.name = index, name

    def __repr__(self) -> str:
        return self.name

    def _no_value(self, *_: Any) -> NoReturn:
        raise TypeError(f"{self.name} has no value while `where` selects")

    __bool__ = __eq__ = __ne__ = _no_value
    __hash__ = object.__hash__


def names_of(osc: Any) -> list[str]:
    """The names of the leaves in their order, such as "belts[0].velocity"."""
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(osc)]
    return [jax.tree_util.keystr(path).removeprefix(".") for path in paths]


def leaf_index(osc: Oscillator, where: Any) -> int:
    """The number of the parameter that `where` selects, among the leaves of the oscillator.

    Programs depend on the number, not on the function: a new lambda in every call would compile
    anew every time. `ValueError` if `where` does not select a parameter.
    """
    expected = (
        f"a function that selects one parameter{_of(osc)}, unchanged, such as "
        "`lambda osc: osc.belts[0].velocity`"
    )
    chosen = _ask(osc, where, expected)
    require(_is_parameter(osc, chosen), "where", expected, _told(chosen))
    return chosen.index


def leaf_groups(osc: Oscillator, where: Any) -> tuple[tuple[int, ...], ...]:
    """The numbers of the leaves of each parameter that `where` selects, as for `fit`.

    `where` returns a leaf, or a tuple with an entry for each parameter: a leaf, or a tuple of
    leaves that are to be equal. `ValueError` for anything else, and for a leaf that comes twice.
    """
    expected = (
        f"a function that selects parameters{_of(osc)}, unchanged: one, or a tuple, each entry a "
        "number or a tuple of numbers kept equal, such as `lambda osc: (osc.damping, osc.omega)`"
    )
    chosen = _ask(osc, where, expected)
    groups = [_tuple(one) for one in _tuple(chosen)]
    flat = [leaf for group in groups for leaf in group]
    fine = groups and all(groups) and all(_is_parameter(osc, leaf) for leaf in flat)
    require(fine, "where", expected, _told(chosen))
    numbers = [leaf.index for leaf in flat]
    require(len(set(numbers)) == len(numbers), "where", "free of repeats", _told(chosen))
    return tuple(tuple(leaf.index for leaf in group) for group in groups)


def _ask(osc: Oscillator, where: Any, expected: str) -> Any:
    """What `where` returns for a copy of the oscillator whose leaves are `Parameter`s."""
    require_callable(where, "where", expected)
    leaves = [Parameter(index, name) for index, name in enumerate(names_of(osc))]
    try:
        return where(jax.tree.unflatten(jax.tree.structure(osc), leaves))
    except IndexError as error:
        raise ValueError(
            f"where must be {expected}, got one of a belt that is not there"
        ) from error
    except Exception as error:
        came = str(error).partition("\n")[0]
        raise ValueError(f"where must be {expected}, got {type(error).__name__}: {came}") from error


def _is_parameter(osc: Oscillator, chosen: Any) -> bool:
    return isinstance(chosen, Parameter) and is_number(jax.tree.leaves(osc)[chosen.index])


def is_number(leaf: Any) -> bool:
    """Whether a leaf is a single number, which may be varied."""
    return (is_real(leaf) or type(leaf) is int) and np.ndim(leaf) == 0


def is_real(leaf: Any) -> bool:
    """Whether a leaf is a float or an array of floats; a leaf of a user's law may be anything."""
    dtype = getattr(leaf, "dtype", None)
    return type(leaf) is float if dtype is None else bool(jnp.issubdtype(dtype, jnp.floating))


def _of(osc: Oscillator) -> str:
    last = len(osc.belts) - 1
    return f" of an oscillator with {f'belts 0 to {last}' if last else 'one belt, 0'}"


def _tuple(chosen: Any) -> tuple[Any, ...]:
    return chosen if isinstance(chosen, tuple) else (chosen,)


def _told(chosen: Any) -> str:
    """What `where` returned, in words; a module of leaves without values cannot print itself."""
    if isinstance(chosen, tuple | list):
        return f"({', '.join(map(_told, chosen))})"
    if isinstance(chosen, eqx.Module):
        return f"a whole {type(chosen).__name__}"
    return repr(chosen) + ", a number that is no parameter" * isinstance(chosen, float)


def vary(osc: Oscillator, index: int, p: Array) -> Oscillator:
    """The oscillator with the leaf of this number replaced by p, [1]."""
    leaves, structure = jax.tree.flatten(osc)
    # A known array is taken apart by NumPy, which compiles nothing.
    leaves[index] = jnp.asarray(np.asarray(p)[0]) if is_concrete(p) else p[0]
    return jax.tree.unflatten(structure, leaves)


# --- units ----------------------------------------------------------------------------------------


def unit_of(name: str, osc: Oscillator, units: Units) -> tuple[str, float]:
    """SI unit of a parameter of an oscillator, and the size of the oscillator's unit in it.

    Tied parameters, "damping = belts[0].load", must have the same unit. "" and 1 where only the
    author of a force or a law knows it.
    """
    found = set()
    for path in name.split(" = "):
        if ".friction." in path:
            found.add(_unit_in_law(path, osc, units))
        elif dimension := _dimension_of(path, osc):
            symbol, size = SI_UNITS[dimension]
            found.add((symbol, float(size(units))))
        else:
            found.add(("", 1.0))
    require(len(found) == 1, "result", "of tied parameters with one unit", name)
    return found.pop()


def _dimension_of(path: str, osc: Oscillator) -> str | None:
    """Dimension stated by the field of a number, or by a field around it; None: not stated."""
    owner: Any = osc
    dimension = None
    for step in re.findall(r"\w+", path):
        if step.isdecimal():
            owner = owner[int(step)]
            continue
        stated = type(owner).__dataclass_fields__[step].metadata.get("dimensions")
        (dimension,) = stated or (dimension,)
        owner = getattr(owner, step)
    return dimension


def _unit_in_law(path: str, osc: Oscillator, units: Units) -> tuple[str, float]:
    """SI unit of a number of a friction law, and the size of the oscillator's unit in it.

    It follows from how the number changes when speeds are given in another unit; "" and 1 where the
    law takes speeds in a unit that only its author knows.
    """
    number = names_of(osc).index(path)
    leaves, structure = jax.tree.flatten(osc)
    if not np.any(leaves[number]):
        leaves[number] = jnp.ones(())
        osc = jax.tree.unflatten(structure, leaves)
    index = int(path.removeprefix("belts[").partition("]")[0])
    law = osc.belts[index].friction
    halved = law.in_units_of(jnp.asarray(2.0))
    if isinstance(law, LawInUnits) or type(halved) is not type(law):
        return "", 1.0
    scaled = eqx.tree_at(lambda o: o.belts[index].friction, osc, halved)
    ratio = float(jax.tree.leaves(scaled)[number] / leaves[number])
    power = round(np.log2(ratio)) if ratio > 0 else 0
    is_power = abs(ratio / 2.0**power - 1) < POWER_ROUNDING
    require(is_power, "result", "of what goes with a power of the speed in in_units_of", path)
    symbol = " ".join(
        unit + (str(n) if n != 1 else "")
        for n, unit in sorted(((power, "s"), (-power, "m")), reverse=True)
        if n
    )
    return symbol or "1", float(units.velocity) ** -power
