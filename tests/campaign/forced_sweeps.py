"""Final states of forced oscillators by `sweep`, against the engine's.

A case of this campaign is a batch of runs of one structure, which is one call of the package.
"""

from dataclasses import replace
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

import jaxbelt as jb
from jaxbelt.model.own_units import in_units_of_run
from jaxbelt.sweeps import question

from . import forced, forced_cases, forced_package
from .forced_runs import compared
from .forced_runs import settings as settings
from .package import Final
from .runs import said as said

#: Number of runs in one call, and of structures; each structure is a compilation.
BATCH, PROGRAMS = 1024, 14
_SIZES = {"conti": 4, "coulomb": 2, "stribeck": 3, "cubic": 3}


def numbers(options):
    return range(len(_batches(options)))


def _batches(options):
    return forced_cases.batches(options, BATCH, PROGRAMS)


def outcome(options, number):
    structure, count = _batches(options)[number]
    rng = np.random.default_rng((options.seed, number))
    batch = [from_zero(forced_cases.case(rng, structure)) for _ in range(count)]
    return compared(batch, finals(batch, options.tol), options)


def from_zero(case):
    """The same run shifted to begin at t = 0, because all runs of a sweep begin together."""

    def later(wave):
        if not isinstance(wave, forced.Oscillating | forced.Harmonic):
            return wave
        return replace(wave, phase=wave.phase + wave.frequency * case.t0)

    osc = case.oscillator
    belts = tuple(replace(b, velocity=later(b.velocity), load=later(b.load)) for b in osc.belts)
    moved = replace(osc, belts=belts, forces=tuple(map(later, osc.forces)))
    return replace(case, oscillator=moved, t0=0.0, T=round(case.T - case.t0, 9))


def row_of(case):
    """All numbers of a case in the order that `_from_numbers` expects."""
    osc = case.oscillator
    row = [osc.damping, osc.omega]
    for b in osc.belts:
        for wave in (b.velocity, b.load):
            row += list(vars(wave).values()) if isinstance(wave, forced.Oscillating) else [wave]
        law = [float(v) for v in b.law[1:]]
        row += law + [0.0] * (_SIZES[b.law[0]] - len(law))
        row += [b.lower, b.upper] if case.structure.edges else []
    for f in osc.forces:
        row += list(vars(f).values())
    return [float(v) for v in row]


def _from_numbers(structure, row):
    values = iter(row)
    damping, omega = next(values), next(values)

    def wave(oscillates):
        return jb.Oscillating(*(next(values) for _ in range(4))) if oscillates else next(values)

    belts = []
    rows = zip(structure.laws, structure.velocities, structure.loads, strict=True)
    for law, moves, swells in rows:
        velocity, load = wave(moves), wave(swells)
        friction = forced_package.LAWS[law](*(next(values) for _ in range(_SIZES[law])))
        edges = (next(values), next(values)) if structure.edges else ()
        belts.append(jb.Belt(velocity, friction, load, *edges))
    forces = tuple(
        forced_package.FORCES[kind](*(next(values) for _ in range(3))) for kind in structure.kinds
    )
    return jb.Oscillator(damping, tuple(belts), omega, forcing=forces)


def swept(cases, observe, **options):
    """Variables of `jb.sweep` over cases of one structure and one T; all numbers vary by case."""
    structure = cases[0].structure
    table = np.array([row_of(case) for case in cases])
    starts = np.array([case.y0 for case in cases], dtype=float)

    def leaves(row):
        osc = in_units_of_run(_from_numbers(structure, row), edges=structure.edges)
        return jnp.stack([jnp.asarray(leaf, float) for leaf in jax.tree.leaves(osc)])

    whole = np.column_stack([starts, np.asarray(jax.vmap(leaves)(jnp.asarray(table)))])

    class Cases(question.Grid):
        def rows(self, runs, derivatives=()):
            varying = [True, True, *self.mapped]
            return whole[runs][:, varying].T[None]

    def make(case):
        return _from_numbers(structure, [value + 0 * case for value in table[0]])

    with mock.patch.object(question, "Grid", Cases):
        axes = {"case": np.arange(len(cases), dtype=float)}
        return jb.sweep(make, axes, observe=observe, progress=False, **options)


def finals(cases, tol, **options):
    """Final states by the sweep."""
    found = swept(cases, "final", t1=cases[0].T, rtol=tol, atol=tol, **options)
    columns = found.x1_end, found.x2_end, found.mode_end, found.n_events, found.status
    rows = zip(*(column.values for column in columns))
    return [Final(float(a), float(b), tuple(m.tolist()), int(n), int(s)) for a, b, m, n, s in rows]
