"""The transitions between modes: one table, and every engine held to it.

A mode is a contact code a belt: +1 or -1 the mass slips with that sign of r = nu - omega x2, 0 it
sticks, -2 it is below the belt's contact interval, +2 above. Each row is a start, the mode that it
is in, the first event, (kind, belt), and the mode after that. All belts follow Coulomb's law with
static coefficient 1 and kinetic coefficient 1/2, and there is no damping, so

    x2' = -x1 + sum of s/2 load,    and a belt holds a needed force of size up to its load.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax.numpy as jnp
import lists
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt import EventKind, Oscillator, Status
from jaxbelt.cycles.orbits import follow
from jaxbelt.model.events import event_between, events_of
from jaxbelt.numerics.compiling import jit

CROSS, EDGE, SLIP, STICK = EventKind.CROSS, EventKind.EDGE, EventKind.SLIP, EventKind.STICK
BELOW, ABOVE = -2, 2


def belt(nu: float, load: float = 1.0, lower: float = -np.inf, upper: float = np.inf) -> jb.Belt:
    return jb.Belt(nu, jb.Coulomb(static=1.0, kinetic=0.5), load, lower, upper)


class Row(NamedTuple):
    """A start y = (x1, x2), its mode, the first event, (kind, belt), and the mode afterwards."""

    name: str
    belts: tuple[jb.Belt, ...]
    y: tuple[float, float]
    mode: tuple[int, ...]
    event: tuple[EventKind, int]
    after: tuple[int, ...]


ONE, BACK, STILL = (belt(0.5),), (belt(-0.5),), (belt(0.0),)
OPPOSED = (belt(0.5), belt(-0.5))
EQUAL = (belt(0.5), belt(0.5))

# fmt: off
TABLE = [
    # A boundary r = 0 is reached. Needed is -x1 plus the friction of the other belts.
    Row("held: it sticks",               ONE,     (-0.3, 0.4), (1,),    (STICK, 0), (0,)),
    Row("held, from above",              ONE,     (0.3, 0.7),  (-1,),   (STICK, 0), (0,)),
    Row("not held: it crosses",          ONE,     (-2.0, 0.4), (1,),    (CROSS, 0), (-1,)),
    Row("not held, from above",          ONE,     (2.0, 0.7),  (-1,),   (CROSS, 0), (1,)),
    Row("the other belt helps to hold",  OPPOSED, (-1.3, 0.4), (1, -1), (STICK, 0), (0, -1)),
    Row("the other belt pulls it over",  OPPOSED, (0.7, 0.6),  (-1, -1),(CROSS, 0), (1, -1)),
    Row("the lower one of two",          OPPOSED, (0.4, -0.4), (1, -1), (STICK, 1), (1, 0)),
    Row("belt at rest, held",            STILL,   (0.3, 0.2),  (-1,),   (STICK, 0), (0,)),
    Row("belt at rest, not held",        STILL,   (-2.0, -.1), (1,),    (CROSS, 0), (-1,)),
    Row("belt without load",     (belt(0.5, 0.0),), (-.3, .45), (1,),   (CROSS, 0), (-1,)),
    Row("equal speeds: loads add up",    EQUAL,   (-1.7, 0.4), (1, 1),  (STICK, 0), (0, 0)),
    Row("equal speeds, not held",        EQUAL,   (-3.0, 0.4), (1, 1),  (CROSS, 0), (-1, -1)),

    # Slip onset: the new sign is that of the belt's velocity.
    Row("onset, belt to the right",      ONE,     (0.9, 0.5),  (0,),    (SLIP, 0),  (1,)),
    Row("onset, belt to the left",       BACK,    (-.9, -.5),  (0,),    (SLIP, 0),  (-1,)),
    Row("onset beside another belt",     OPPOSED, (0.4, 0.5),  (0, -1), (SLIP, 0),  (1, -1)),
    Row("onset from two belts",          EQUAL,   (1.9, 0.5),  (0, 0),  (SLIP, 0),  (1, 1)),

    # A contact edge is met in slip: it is passed, and belts that stay keep their sign.
    Row("a belt arrives, from the left", (belt(0.5), belt(-0.2, lower=0.0)),
        (-0.1, 0.3), (1, BELOW), (EDGE, 1), (1, -1)),
    Row("a belt arrives, from the right", (belt(0.5), belt(-0.2, upper=0.0)),
        (0.1, -0.4), (1, ABOVE), (EDGE, 1), (1, 1)),
    Row("a belt is left, to the left",   (belt(0.5), belt(-0.2, lower=0.0)),
        (0.05, -0.4), (1, 1), (EDGE, 1), (1, BELOW)),
    Row("a belt is left, to the right",  (belt(0.5), belt(-0.2, 0.5, upper=0.0)),
        (-0.1, 0.3), (1, -1), (EDGE, 1), (1, ABOVE)),
    Row("one belt after another",        (belt(0.5, upper=0.0), belt(-0.2, lower=0.0)),
        (-0.1, 0.3), (1, BELOW), (EDGE, 0), (ABOVE, -1)),
    Row("no belt is left",               (belt(0.5, upper=0.0),),
        (-0.1, 0.3), (1,), (EDGE, 0), (ABOVE,)),

    # A contact edge is met while the mass sticks.
    Row("a belt arrives: still held",    (belt(0.5), belt(-0.2, lower=0.0)),
        (-0.1, 0.5), (0, BELOW), (EDGE, 1), (0, -1)),
    Row("a belt arrives: torn off",      (belt(0.5), belt(-0.2, 3.0, lower=0.0)),
        (-0.1, 0.5), (0, BELOW), (EDGE, 1), (1, -1)),
    Row("one of that speed arrives",     (belt(0.5), belt(0.5, lower=0.0)),
        (-0.1, 0.5), (0, BELOW), (EDGE, 1), (0, 0)),
    Row("another is left: still held",   (belt(0.5), belt(-0.2, upper=0.0)),
        (-0.1, 0.5), (0, -1), (EDGE, 1), (0, ABOVE)),
    Row("another is left at the limit: still held", (belt(0.5), belt(-0.5, upper=0.5)),
        (0.4, 0.5), (0, -1), (EDGE, 1), (0, ABOVE)),
    Row("another is left: torn off",     (belt(0.5), belt(0.9, 3.0, upper=1.4)),
        (1.3, 0.5), (0, 1), (EDGE, 1), (1, ABOVE)),
    Row("its own is left: slip",         (belt(0.5, upper=0.0), belt(-0.2)),
        (-0.1, 0.5), (0, -1), (EDGE, 0), (ABOVE, -1)),
    Row("its own is left: the other holds it", (belt(0.5, upper=0.0), belt(0.5)),
        (-0.1, 0.5), (0, 0), (EDGE, 0), (ABOVE, 0)),
    Row("onset on the edge itself",      (belt(0.5, upper=1.0),),
        (0.9, 0.5), (0,), (EDGE, 0), (ABOVE,)),

    # Starts on a boundary or an edge: the mode is that in which the orbit goes on.
    Row("on a boundary, pulled down",    ONE,     (1.2, 0.5),  (1,),    (STICK, 0), (0,)),
    Row("on a boundary, pulled up",      ONE,     (-1.2, 0.5), (-1,),   (STICK, 0), (0,)),
    Row("on an edge, to the right",      (belt(0.5), belt(-0.2, lower=0.0)),
        (0.0, 0.3), (1, -1), (STICK, 1), (1, 0)),
    Row("on an edge, to the left",       (belt(0.5), belt(-0.2, lower=0.0)),
        (0.0, -0.4), (1, BELOW), (EDGE, 1), (1, -1)),
    Row("at rest on an edge, pushed right", (belt(0.5), belt(0.5, lower=0.0)),
        (0.0, 0.0), (1, 1), (STICK, 0), (0, 0)),
    Row("at rest on an edge, pushed left", (belt(-0.3), belt(-0.3, lower=0.0)),
        (0.0, 0.0), (-1, BELOW), (STICK, 0), (0, BELOW)),
    Row("at rest in a slip mode",        ONE,     (-0.4, 0.0), (1,),    (STICK, 0), (0,)),
]
# fmt: on


def beside_another(belts: tuple[jb.Belt, ...]) -> tuple[jb.Belt, ...]:
    """Two belts with an edge, one of them where no row comes to: of a structure that one program
    of each engine serves."""
    if len(belts) == 1:
        return *belts, belt(-0.2, lower=FAR)
    if not np.any(np.isfinite([(one.lower, one.upper) for one in belts])):
        return belts[0], dataclasses.replace(belts[1], upper=jnp.asarray(FAR))
    return belts


FAR = 40.0


def steady(nu: float, mu: float, lower: float = -np.inf, upper: float = np.inf) -> jb.Belt:
    """Of a constant friction, by the law of most other tests, for one program with them."""
    return jb.Belt(nu, jb.Conti(mu, mu, 10.0), 1.0, lower, upper)


#: Starts at which the motion ends at once: its mode, and the status of a run.
RESTS = {
    "fixed point of a slip mode": (
        (steady(0.5, 0.5), steady(-0.2, 0.5, lower=FAR)),
        *((0.5, 0.0), (1, BELOW), Status.EQUILIBRIUM),
    ),
    "stuck to a belt at rest": (
        (steady(0.0, 1.0), steady(-0.2, 1.0, lower=FAR)),
        *((0.9, 0.0), (0, BELOW), Status.STUCK_FOREVER),
    ),
    "pushed back by both sides of an edge": (
        (steady(0.5, 0.5, upper=0.0), steady(-0.5, 0.5, lower=0.0)),
        *((0.0, 0.0), (1, BELOW), Status.PSEUDO_FOCUS),
    ),
}


class Seen(NamedTuple):
    """What an engine does: the mode at the start, the first event, the mode after it."""

    mode: tuple[int, ...]
    event: tuple[EventKind, int]
    after: tuple[int, ...]


LONG, AT_ONCE = 8.0, 1e-6  # more than a period; less than any arc of the table
ARCS = 4096  # room for as many as in tests/test_simulate.py, for one program


def ints(codes) -> tuple[int, ...]:
    return tuple(int(code) for code in codes)


def by_simulate(osc: Oscillator, y) -> Seen:
    run = jb.simulate(osc, y, LONG, max_segments=ARCS)
    events, arcs = run.events, run.arcs
    after = next(mode for mode in np.asarray(arcs.mode) if np.any(mode != arcs.mode[0]))
    return Seen(
        ints(arcs.mode[0]), (EventKind(int(events.kind[0])), int(events.belt[0])), ints(after)
    )


@jit
def orbit_of(osc: Oscillator, y):
    return follow(osc, y, 16)


def by_orbit(osc: Oscillator, y) -> Seen:
    """As `find_cycle` follows it."""
    orbit = orbit_of(osc, jnp.array(y))
    codes = np.vstack([np.asarray(orbit.codes)[: int(orbit.count)], orbit.code])
    row = np.flatnonzero(np.any(np.diff(codes, axis=0) != 0, axis=1))[0]
    kind, number = event_between([*codes[row]], [*codes[row + 1]])
    return Seen(ints(codes[0]), (EventKind(int(kind)), int(number)), ints(codes[row + 1]))


class FirstEvent:
    """A reducer: time, kind and belt of the first event of a run."""

    def init(self, osc, x1, x2):
        return jnp.array([jnp.inf, 0.0, -1.0])

    def update(self, state, event):
        new = jnp.stack([event.t, event.kind.astype(float), event.belt.astype(float)])
        return jnp.where(state[1] == 0, new, state)

    def finish(self, state, end):
        return {"first": state}


FIRST = FirstEvent()


@functools.cache
def made(beside: bool, count: int):
    """The function that makes the oscillator of a row, and the rows of so many belts."""
    rows = [row for row in TABLE if beside or len(row.belts) == count]
    return lists.maker([oscillator(row, beside) for row in rows]), rows


@functools.cache
def from_all_starts(beside: bool, count: int, t1: float, observe):
    """What the rows do from the starts of them all."""
    make, rows = made(beside, count)
    starts = {name: sorted({row.y[i] for row in rows}) for i, name in enumerate(("x1", "x2"))}
    axes = {"case": np.arange(len(rows), dtype=float)} | starts
    return jb.sweep(make, axes, t1=t1, observe=observe, progress=False)


def by_sweep(osc: Oscillator, y, row: Row, beside: bool) -> Seen:
    make, rows = made(beside, len(osc.belts))
    here = {"case": float(rows.index(row)), "x1": y[0], "x2": y[1]}

    def from_start(t1, observe):
        return from_all_starts(beside, len(osc.belts), t1, observe).sel(here)

    t, kind, number = from_start(LONG, FIRST)["first"].values
    after = jb.sweep(
        make, {name: [at] for name, at in here.items()}, t1=t + AT_ONCE, progress=False
    )
    return Seen(
        ints(from_start(AT_ONCE, "final").mode_end.values),
        (EventKind(int(kind)), int(number)),
        ints(after.mode_end.values.ravel()),
    )


def oscillator(row: Row, beside: bool) -> Oscillator:
    return Oscillator(0.0, beside_another(row.belts) if beside else row.belts)


ENGINES = {"simulate": by_simulate, "orbits": by_orbit, "sweep": by_sweep}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    "beside",
    [
        pytest.param(True, id="beside another"),
        # Each number of belts takes a program, and so do belts without edges.
        pytest.param(False, id="alone", marks=pytest.mark.slow(first=True)),
    ],
)
def test_transitions(beside: bool, engine: str):
    """All rows in one test, as they share programs."""

    def expected(row: Row) -> Seen:
        more = (BELOW,) * (len(oscillator(row, beside).belts) - len(row.belts))
        return Seen((*row.mode, *more), row.event, (*row.after, *more))

    def seen(row: Row) -> Seen:
        more = (row, beside) if engine == "sweep" else ()
        return ENGINES[engine](oscillator(row, beside), row.y, *more)

    assert {row.name: seen(row) for row in TABLE} == {row.name: expected(row) for row in TABLE}


def test_rests():
    """Ends that are no events. An equilibrium is no end for a run of `simulate`: it stays."""
    for belts, y, mode, status in RESTS.values():
        osc = Oscillator(0.0, belts)
        run = jb.simulate(osc, y, LONG, max_segments=ARCS)
        ends = status != Status.EQUILIBRIUM
        assert run.status == (status if ends else Status.OK) and run.events.t.size == 0
        np.testing.assert_allclose(run.ys, np.broadcast_to(y, run.ys.shape), atol=1e-15)
        assert ints(run.arcs.mode[0]) == mode

        assert jb.find_cycle(osc, y).status == status

        found = lists.swept([osc], y0=y, t1=LONG, observe="attractor").squeeze()
        kind = "stuck" if status == Status.STUCK_FOREVER else "equilibrium"
        assert jb.decoded(found).kind == kind and found.n_events == 0
        assert (found.x1_min, found.x1_max) == (y[0], y[0])


def test_a_loop_of_no_modes_has_no_events():
    assert events_of(()) == () and events_of(np.zeros((3, 0))) == ()
