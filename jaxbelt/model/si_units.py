"""SI units of dimensions, and of the parameters of an oscillator.

The fields of an oscillator state their dimensions; the unit of a number of a friction law follows
from its `in_units_of`.
"""

import re
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..checks import require
from .friction import LawInUnits
from .machine import Units
from .oscillator import Oscillator
from .parameters import names_of

#: Units of dimensions: the symbol, and the value of 1 in it.
SI_UNITS: dict[str, tuple[str, Callable[[Units], Any]]] = {
    "time": ("s", lambda units: units.time),
    "length": ("m", lambda units: units.length),
    "velocity": ("m s-1", lambda units: units.velocity),
    "force": ("N", lambda units: units.force),
    "energy": ("J", lambda units: units.energy),
    "rate": ("s-1", lambda units: units.rate),
    "damping": ("N s m-1", lambda units: units.force / units.velocity),
    "frequency": ("rad s-1", lambda units: units.rate),
    "angle": ("rad", lambda units: jnp.ones(())),
}
#: Relative accuracy to which a number of a friction law has to follow a power of the unit of speed.
POWER_ROUNDING = 1e-12


def unit_of(name: str, osc: Oscillator, units: Units) -> tuple[str, float]:
    """Unit of a parameter of an oscillator, and the value of 1 in it.

    Tied parameters, "damping = belts[0].load", must have the same. "" and 1 where only the author
    of a force or a law knows it.
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
    """Dimension of a number, of its field or of the field that holds it; None: not stated."""
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
    """Unit of a number of a friction law, and the value of 1 in it.

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
