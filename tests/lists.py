"""Sweeps of lists of oscillators, in which every number varies.

So one program serves all lists of one structure: the kernel of a sweep takes longer to compile than
most tests to run.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxbelt as jb


def maker(oscillators: Sequence[jb.Oscillator]):
    """The function of a number `case` that makes the oscillator of this number, all numbers
    data. One more than there are oscillators is made, the first with an edge: the program for
    contact edges serves those without, too."""
    edged = eqx.tree_at(lambda osc: osc.belts[0].upper, oscillators[0], jnp.asarray(50.0))
    structure = jax.tree.structure(edged)
    columns = [
        np.array([float(leaf) for leaf in leaves])
        for leaves in zip(*map(jax.tree.leaves, [*oscillators, edged]), strict=True)
    ]

    def make(case):
        which = jnp.asarray(case).astype(int)
        return jax.tree.unflatten(structure, [jnp.asarray(column)[which] for column in columns])

    return make


def swept(oscillators: Sequence[jb.Oscillator], axes: dict[str, Any] | None = None, **options):
    """`jb.sweep` over the oscillators, axis `case`, and over further axes."""
    cases = np.arange(len(oscillators) + 1, dtype=float)
    found = jb.sweep(maker(oscillators), {"case": cases} | (axes or {}), progress=False, **options)
    return found if "case" in (axes or {}) else found.isel(case=slice(len(oscillators)))
