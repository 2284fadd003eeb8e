"""The package on cases: final states and labels by `sweep`, trajectories by vmapped `simulate`.

Cases of one structure (laws, edges or none) are one batch of one compiled program: every number of
the oscillator and of the start varies from lane to lane. The package gets each case in the units of
the case, and its answers are converted back; all cases of one call share their units.
"""

import functools
from dataclasses import dataclass
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxbelt as jb
from jaxbelt.model.events import of_one_loop
from jaxbelt.model.own_units import in_units_of_run
from jaxbelt.sweeps import question

from . import engine


class Peak(jb.AbstractFriction):
    """mu(r) = kinetic + (static - kinetic) exp(-(r/velocity)^2) + viscous r, a user's own law."""

    static: jax.Array
    kinetic: jax.Array
    velocity: jax.Array
    viscous: jax.Array

    def mu(self, speed):
        falls = (self.static - self.kinetic) * jnp.exp(-((speed / self.velocity) ** 2))
        return self.kinetic + falls + self.viscous * speed


def _peak(*values):
    return Peak(*(jnp.asarray(value, float) for value in values))


_TABLE = jb.Tabulated(*engine.TABLE)


def _table(static, unit):
    law = eqx.tree_at(lambda law: law.static, _TABLE, jnp.asarray(static, float))
    return law.in_units_of(jnp.asarray(unit, float))


_LAWS = {"conti": jb.Conti, "coulomb": jb.Coulomb, "stribeck": jb.Stribeck}
_LAWS |= {"peak": _peak, "table": _table}
_SIZES = {"conti": 4, "coulomb": 2, "stribeck": 3, "peak": 4, "table": 2}


def oscillator(osc):
    """The engine's oscillator as one of the package."""
    belts = tuple(
        jb.Belt(b.velocity, _LAWS[b.law[0]](*b.law[1:]), b.load, b.lower, b.upper)
        for b in osc.belts
    )
    return jb.Oscillator(osc.damping, belts, osc.omega)


def engines(osc):
    """An oscillator of the package with Conti's laws, as one of the engine."""
    names = ("static", "residual", "steepness", "quadratic")
    belts = []
    for b in osc.belts:
        law = ("conti", *(float(getattr(b.friction, name)) for name in names))
        ends = float(b.lower), float(b.upper)
        belts.append(engine.Belt(float(b.velocity), law, float(b.load), *ends))
    return engine.Oscillator(float(osc.damping), tuple(belts), float(osc.omega))


def as_code(case):
    """The case as an expression for a notebook."""
    osc, y0 = case.given
    belts = []
    for b in osc.belts:
        own = b.law[0] in ("peak", "table")
        name = f"package._{b.law[0]}" if own else f"jb.{b.law[0].capitalize()}"
        law = f"{name}({', '.join(repr(float(v)) for v in b.law[1:])})"
        edges = "".join(
            f", {name}={value!r}"
            for name, value in (("lower", b.lower), ("upper", b.upper))
            if np.isfinite(value)
        )
        belts.append(f"jb.Belt({b.velocity!r}, {law}, {b.load!r}{edges})")
    return (
        f"jb.Oscillator({osc.damping!r}, ({', '.join(belts)},), {osc.omega!r}), "
        f"y0={y0!r}, t1={case.T!r}"
    )


def numbers(case):
    """All numbers of a case in the order that `_from_numbers` expects."""
    (osc, _), (laws, edges) = case.given, case.structure
    row = [osc.damping, osc.omega]
    for b, law in zip(osc.belts, laws):
        p = [float(v) for v in b.law[1:]]
        row += [b.velocity, b.load, *p, *[0.0] * (_SIZES[law] - len(p))]
        row += [b.lower, b.upper] if edges else []
    return [float(v) for v in row]


def tangent(case, direction):
    """A direction of `derivatives.directions` in the order of `numbers`, and that of the start."""
    start, damping, belts = direction
    length, speed = case.units.length, case.units.speed
    _, edges = case.structure
    row = [damping, 0.0]
    for (velocity, load, lower, upper), b in zip(belts, case.oscillator.belts):
        row += [velocity * speed, load * length, *[0.0] * _SIZES[b.law[0]]]
        row += [lower * length, upper * length] if edges else []
    return row, [x * length for x in start]


def _from_numbers(structure, row):
    laws, edges = structure
    numbers = iter(row)
    damping, omega = next(numbers), next(numbers)
    belts = []
    for law in laws:
        velocity, load = next(numbers), next(numbers)
        friction = _LAWS[law](*(next(numbers) for _ in range(_SIZES[law])))
        bounds = (next(numbers), next(numbers)) if edges else ()
        belts.append(jb.Belt(velocity, friction, load, *bounds))
    return jb.Oscillator(damping, tuple(belts), omega)


# ---------------------------------------------------------------- sweep


def _leaves(structure, table, moves=None):
    """Leaves [cases, leaves] of the oscillators that the kernel takes, from rows of numbers; with
    `moves`, the derivatives of the leaves along these."""

    def leaves(row):
        osc = in_units_of_run(_from_numbers(structure, row))
        return jnp.stack([jnp.asarray(leaf, float) for leaf in jax.tree.leaves(osc)])

    if moves is None:
        return np.asarray(jax.vmap(leaves)(jnp.asarray(table)))
    along = jax.vmap(lambda row, move: jax.jvp(leaves, (row,), (move,))[1])
    return np.asarray(along(jnp.asarray(table), jnp.asarray(moves)))


def swept(cases, observe, directions=None, **options):
    """The variables of `jb.sweep` over cases of one structure and one T.

    Axes of a sweep cannot give every run its own start; here a patched grid does. directions: one
    for each case; the derivatives along them are those by "case".
    """
    structure = cases[0].structure
    table = np.array([numbers(case) for case in cases])
    starts = np.array([case.given[1] for case in cases], dtype=float)
    tables = [np.column_stack([starts, _leaves(structure, table)])]
    if directions:
        options["derivatives"] = "case"
        pairs = [tangent(case, direction) for case, direction in zip(cases, directions)]
        rows, moves = (np.array(part) for part in zip(*pairs))
        tables.append(np.column_stack([moves, _leaves(structure, table, rows)]))

    class Cases(question.Grid):
        def rows(self, runs, derivatives=()):
            varying = [True, True, *self.mapped]
            return np.stack([t[runs][:, varying].T for t in tables[: 1 + len(derivatives)]])

    def make(case):
        # Every number depends on the axis, so that every one varies.
        return _from_numbers(structure, [value + 0 * case for value in table[0]])

    with mock.patch.object(question, "Grid", Cases):
        axes = {"case": np.arange(len(cases), dtype=float)}
        return jb.sweep(make, axes, observe=observe, progress=False, **options)


@dataclass(frozen=True)
class Final:
    """How a run ended; events: (t, kind, belt, x1, x2) each, or None if not recorded."""

    x1: float
    x2: float
    mode: tuple
    n_events: int
    status: int
    events: tuple | None = None


def finals(cases, tol):
    """Final states by the sweep."""
    length = cases[0].units.length
    found = swept(cases, "final", t1=cases[0].T, rtol=tol, atol=tol * length)
    x1, x2 = found.x1_end.values / length, found.x2_end.values / length
    status = found.status.values
    modes, events = found.mode_end.values, found.n_events.values
    return [
        Final(float(a), float(b), tuple(m.tolist()), int(n), int(s))
        for a, b, m, n, s in zip(x1, x2, modes, events, status)
    ]


@dataclass(frozen=True)
class Label:
    kind: str
    period: float
    loop: tuple
    x1: tuple
    x2: tuple
    sticks: tuple
    status: int


def labels(cases, tol, **options):
    """Attractors by the sweep."""
    length = cases[0].units.length
    found = swept(cases, "attractor", rtol=tol, atol=tol * length, **options)
    words = jb.decoded(found)
    out = []
    for i in range(len(cases)):
        row = found.isel(case=i)
        out.append(
            Label(
                str(words.kind.values[i]),
                float(row.period),
                _loop(str(words.signature.values[i])),
                (float(row.x1_min) / length, float(row.x1_max) / length),
                (float(row.x2_min) / length, float(row.x2_max) / length),
                tuple(row.stick_duration.values.tolist()),
                int(row.status),
            )
        )
    return out


def cycles(cases):
    """Attractors by `find_cycle`, one by one."""
    out = []
    for case in cases:
        (osc, y0), length = case.given, case.units.length
        found = jb.find_cycle(oscillator(osc), y0)
        status = int(found.status)
        kind = {0: "cycle", 1: "stuck", 2: "equilibrium", 6: "equilibrium"}.get(status, "undecided")
        loop = of_one_loop([(int(k), int(b)) for k, b in found.signature])
        out.append(
            Label(
                kind,
                float(found.period),
                loop,
                (float(found.x1_min) / length, float(found.x1_max) / length),
                (float(found.x2_min) / length, float(found.x2_max) / length),
                tuple(np.asarray(found.stick_durations).tolist()),
                status,
            )
        )
    return out


def _loop(word):
    """Events (kind, belt) of a signature in words; None if it was too long."""
    if word in ("none", "smooth"):
        return ()
    if word == "long":
        return None
    events = []
    for part in word.split("-"):
        name = part.rstrip("0123456789")
        events.append((int(jb.EventKind[name.upper()]), int(part[len(name) :])))
    return tuple(events)


# ---------------------------------------------------------------- simulate

#: Runs in one vmapped call.
CHUNK = 64


@functools.cache
def _trajectories(structure, T, tol, max_segments):
    def one(row, y0, length):
        found = jb.simulate(
            _from_numbers(structure, row),
            y0,
            T,
            ts=jnp.array([T]),
            rtol=tol,
            atol=tol * length,
            max_segments=max_segments,
            max_events=max_segments,
        )
        return found.ys[-1], found.modes[-1], found.events, found.status

    return jax.jit(jax.vmap(one, in_axes=(0, 0, None)))


#: max_segments of runs for which the default of `simulate` was too small.
MANY_SEGMENTS = 32768


def simulated(cases, tol):
    """Trajectories by `simulate`; with MANY_SEGMENTS where the default was too small."""
    found = _simulated(cases, tol, None)
    short = [i for i, one in enumerate(found) if one.status == jb.Status.TOO_MANY_SEGMENTS]
    for i, one in zip(short, _simulated([cases[i] for i in short], tol, MANY_SEGMENTS)):
        found[i] = one
    return found


def _simulated(cases, tol, max_segments):
    """Trajectories by `simulate`, vmapped over cases of one structure and one T."""
    if not cases:
        return []
    run = _trajectories(cases[0].structure, cases[0].T, tol, max_segments)
    length, out = cases[0].units.length, []
    for first in range(0, len(cases), CHUNK):
        some = cases[first : first + CHUNK]
        padded = some + [some[0]] * (CHUNK - len(some))
        table = jnp.array([numbers(case) for case in padded])
        starts = jnp.array([case.given[1] for case in padded], dtype=float)
        found = run(table, starts, jnp.asarray(length))
        ys, modes, events, status = jax.tree.map(np.asarray, found)
        for i in range(len(some)):
            known = events.kind[i] > 0
            rows = zip(
                events.t[i][known].tolist(),
                events.kind[i][known].tolist(),
                events.belt[i][known].tolist(),
                *(events.y[i][known].T / length).tolist(),
            )
            out.append(
                Final(
                    *map(float, ys[i] / length),
                    tuple(modes[i].tolist()),
                    int(known.sum()),
                    int(status[i]),
                    tuple(rows),
                )
            )
    return out


# ---------------------------------------------------------------- derivatives


@functools.cache
def _pushed(structure, T, tol):
    def end(row, y0, length):
        found = jb.simulate(
            _from_numbers(structure, row), y0, T, ts=jnp.array([T]), rtol=tol, atol=tol * length
        )
        return found.ys[-1]

    def pushed(row, y0, d, length):
        return jax.jvp(lambda row, y0: end(row, y0, length), (row, y0), d)[1]

    return jax.jit(jax.vmap(pushed, in_axes=(0, 0, 0, None)))


def derivatives(cases, directions, tol, by):
    """d(x1, x2 at T) along one direction for each case; by: "simulate" or "sweep"."""
    length = cases[0].units.length
    if by == "sweep":
        found = swept(cases, "final", directions, t1=cases[0].T, rtol=tol, atol=tol * length)
        columns = [found.d_x1_end_d_case.values, found.d_x2_end_d_case.values]
        return np.column_stack(columns) / length
    run, out = _pushed(cases[0].structure, cases[0].T, tol), []
    for first in range(0, len(cases), CHUNK):
        some = cases[first : first + CHUNK]
        padding = CHUNK - len(some)
        rows, moves = zip(*map(tangent, some, directions[first : first + CHUNK]))
        table = [numbers(case) for case in some]
        starts = [case.given[1] for case in some]
        parts = (
            jnp.array(list(part) + [part[0]] * padding, dtype=float)
            for part in (table, starts, rows, moves)
        )
        table, starts, rows, moves = parts
        found = run(table, starts, (rows, moves), jnp.asarray(length))
        out.append(np.asarray(found)[: len(some)] / length)
    return np.concatenate(out)


@functools.cache
def _pushed_cycle(structure):
    def period(row, y0):
        return jb.period(jb.find_cycle(_from_numbers(structure, row), y0))

    return jax.jit(lambda row, y0, d: jax.jvp(lambda row: period(row, y0), (row,), (d,))[1])


def period_derivatives(cases, directions):
    """d(period) of the cycle that each start leads to, along one direction for each case."""
    out = []
    for case, direction in zip(cases, directions):
        row = jnp.array(numbers(case))
        along = jnp.array(tangent(case, direction)[0])
        out.append(float(_pushed_cycle(case.structure)(row, jnp.array(case.given[1]), along)))
    return np.array(out)
