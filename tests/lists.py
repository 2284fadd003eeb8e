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


def swept(oscillators: Sequence[jb.Oscillator], axes: dict[str, Any] | None = None, **options):
    """`jb.sweep` over the oscillators, axis `case`, and over further axes."""
    # One more, left out of the result: the program for contact edges serves those without, too.
    edged = eqx.tree_at(lambda osc: osc.belts[0].upper, oscillators[0], jnp.asarray(50.0))
    structure = jax.tree.structure(edged)
    columns = [
        np.array([float(leaf) for leaf in leaves])
        for leaves in zip(*map(jax.tree.leaves, [*oscillators, edged]), strict=True)
    ]

    def make(case):
        which = jnp.asarray(case).astype(int)
        return jax.tree.unflatten(structure, [jnp.asarray(column)[which] for column in columns])

    cases = np.arange(len(columns[0]), dtype=float)
    found = jb.sweep(make, {"case": cases} | (axes or {}), progress=False, **options)
    return found if "case" in (axes or {}) else found.isel(case=slice(len(oscillators)))
