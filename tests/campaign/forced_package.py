"""The package on forced cases: trajectories by `simulate`, and their derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxbelt as jb

from . import forced, forced_cases
from .package import MANY_SEGMENTS, Final

FORCES = {forced.Harmonic: jb.Harmonic, forced.BaseMotion: jb.BaseMotion}
LAWS = {
    "conti": jb.Conti,
    "coulomb": jb.Coulomb,
    "stribeck": jb.Stribeck,
    "cubic": jb.Cubic,
}


def _wave(wave):
    return jb.Oscillating(**vars(wave)) if isinstance(wave, forced.Oscillating) else wave


def oscillator(osc):
    """The engine's oscillator as one of the package."""
    belts = tuple(
        jb.Belt(_wave(b.velocity), LAWS[b.law[0]](*b.law[1:]), _wave(b.load), b.lower, b.upper)
        for b in osc.belts
    )
    forces = tuple(FORCES[type(f)](f.amplitude, f.frequency, f.phase) for f in osc.forces)
    return jb.Oscillator(osc.damping, belts, osc.omega, forcing=forces)


def final(run):
    """A trajectory whose only sample is at its end, as a `Final` for the comparison."""
    events = jax.tree.map(np.asarray, run.events)
    known = events.kind > 0
    columns = (events.t, events.kind, events.belt, *events.y.T)
    rows = tuple(zip(*(column[known].tolist() for column in columns)))
    x1, x2 = np.asarray(run.ys)[-1].tolist()
    mode = tuple(np.asarray(run.modes)[-1].tolist())
    return Final(x1, x2, mode, len(rows), int(run.status), rows)


def simulated(cases, tol, **options):
    """Trajectories by `simulate`, one by one; MANY_SEGMENTS where the default was too small."""
    out = []
    for case in cases:
        given = dict(t0=case.t0, ts=[case.T], rtol=tol, atol=tol) | options
        osc = oscillator(case.oscillator)
        run = jb.simulate(osc, case.y0, case.T, **given)
        if int(run.status) == jb.Status.TOO_MANY_SEGMENTS:
            run = jb.simulate(osc, case.y0, case.T, **given | {"max_segments": MANY_SEGMENTS})
        out.append(final(run))
    return out


# ---------------------------------------------------------------- derivatives


def _rest(case):
    """The numbers of the laws that `forced_cases.moved` does not move."""
    return [float(v) for b in case.belts for v in b.law[2:]]


def _sizes(case):
    return tuple(len(b.law) - 2 for b in case.belts)


def _of_numbers(structure, sizes, values, rest):
    """The start and the oscillator from numbers in the order of `forced_cases._numbers`."""
    values, rest = iter(values), iter(rest)
    y0 = jnp.stack([next(values), next(values)])
    damping, omega = next(values), next(values)

    def wave(oscillates):
        return jb.Oscillating(*(next(values) for _ in range(4))) if oscillates else next(values)

    belts = []
    rows = zip(structure.laws, structure.velocities, structure.loads, sizes, strict=True)
    for law, moves, swells, size in rows:
        velocity, load, static = wave(moves), wave(swells), next(values)
        friction = LAWS[law](static, *(next(rest) for _ in range(size)))
        edges = next(values), next(values)
        belts.append(jb.Belt(velocity, friction, load, *(edges if structure.edges else ())))
    forces = tuple(FORCES[kind](*(next(values) for _ in range(3))) for kind in structure.kinds)
    return y0, jb.Oscillator(damping, tuple(belts), omega, forcing=forces)


@functools.cache
def _pushed(structure, sizes, tol, max_segments):
    def end(values, rest, t0, t1):
        y0, osc = _of_numbers(structure, sizes, values, rest)
        given = dict(t0=t0, ts=t1[None], rtol=tol, atol=tol, max_segments=max_segments)
        return jb.simulate(osc, y0, t1, **given).ys[-1]

    def along(values, rest, t0, t1, direction):
        return jax.jvp(end, (values, rest, t0, t1), direction)

    return jax.jit(along)


def derivative(case, direction, tol=1e-11, times=(0.0, 0.0), max_segments=2048):
    """d(x1, x2 at T) along a direction of the numbers of a case, and of t0 and T."""
    values, names = forced_cases._numbers(case)
    # Infinite numbers have no derivative.
    direction = np.where(np.isfinite(values), direction, 0.0)
    # As in `forced_cases.moved`: Coulomb's law without a jump stays without one.
    statics = [d for d, name in zip(direction, names) if name[0] == "static"]
    rest = []
    for b, d in zip(case.belts, statics, strict=True):
        same = b.law[0] == "coulomb" and b.law[1] == b.law[2]
        rest += [d] if same else [0.0] * (len(b.law) - 2)
    run = _pushed(case.structure, _sizes(case), tol, max_segments)
    numbers = (jnp.asarray(v, float) for v in (values, _rest(case), case.t0, case.T))
    tangents = tuple(jnp.asarray(v, float) for v in (direction, rest, *times))
    return np.asarray(run(*numbers, tangents)[1])
