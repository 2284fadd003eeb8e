"""Relations between motions that must hold whatever the parameters are.

One oscillator described in two ways moves in one way: seen in a mirror, with its belts in another
order, in another unit of velocity, with a belt that presses with nothing, with one belt as two of
half the load. So does a run that is cut in two, and a lane of a sweep whatever its neighbours do.
Half of the oscillators are of round numbers, on which boundaries, edges and equilibria meet.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import lists
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt import EventKind, Status
from jaxbelt.sweeps import threads as sweep_threads

#: Time of the runs, and at which times they are compared.
T1 = 15.0
#: As many, and room for as many arcs, as in tests/test_simulate.py, for one program.
SAMPLES, ARCS = 241, 4096
#: Tolerance of states and times: rounding, grown by what the motion amplifies. Runs are integrated
#: to 1e-10; those of one relation take the same steps.
CLOSE = 1e-9
#: What happens within such a time of a start or a cut happens there.
AT_ONCE = 1e-7


# --- oscillators ----------------------------------------------------------------------------------


def round_numbers(rng: np.random.Generator) -> tuple[jb.Oscillator, np.ndarray]:
    """Multiples of 1/20, the belts alike in this or that, and a start, perhaps on a boundary, an
    edge, a corner or where a stick phase ends."""

    def twentieths(first, last):
        return rng.integers(20 * first, 20 * last + 1) / 20

    def law():
        return jb.Conti(rng.choice([1.0, 1.2]), rng.choice([0.5, 0.6]), rng.choice([5.0, 10.0]))

    def pair(choose):
        one = choose()
        return [one, one if rng.random() < 0.5 else choose()]

    def velocity():
        return 0.0 if rng.random() < 0.1 else twentieths(-1, 1)

    laws, loads = pair(law), pair(lambda: rng.choice([0.5, 1.0, 2.0]))
    velocities, sigma = pair(velocity), twentieths(-1, 1)
    bounds = _bounds(rng, sigma, rng.choice([0.0, 0.0, 0.2, 0.5]))
    damping, omega = rng.choice([0.1, 0.25, 0.5]), rng.choice([1.0, 1.0, 0.5, 2.0])
    osc = _two_belts(damping, velocities, laws, loads, bounds, omega)
    x1 = rng.choice([twentieths(-2, 2), sigma, loads[0] * laws[0].static - damping * velocities[0]])
    x2 = rng.choice([twentieths(-2, 2), 0.0, velocities[0] / omega, velocities[1] / omega])
    return osc, np.array([x1, x2])


def any_numbers(rng: np.random.Generator) -> tuple[jb.Oscillator, np.ndarray]:
    def law():
        return jb.Conti(*rng.uniform((0.8, 0.4, 2.0, 0.0), (1.3, 0.7, 12.0, 0.05)))

    bounds = _bounds(rng, rng.normal(0, 0.6), rng.uniform(0, 1))
    velocities, loads = rng.normal(0, 0.5, 2), rng.uniform(0.4, 1.5, 2)
    damping, omega = rng.uniform((0.05, 0.5), (0.8, 2.0))
    osc = _two_belts(damping, velocities, [law(), law()], loads, bounds, omega)
    return osc, rng.normal(0, 1, 2)


def three_belts(rng: np.random.Generator) -> tuple[jb.Oscillator, np.ndarray]:
    (osc, start), (other, _) = round_numbers(rng), any_numbers(rng)
    return changed(osc, (*osc.belts, other.belts[0])), start


def _bounds(rng, sigma, overlap):
    """Contact intervals as of class (b), (c) or (d), to either side."""
    free, left, right = (-np.inf, np.inf), (-np.inf, sigma + overlap), (sigma, np.inf)
    return [(free, free), (left, right), (right, left), (left, free)][rng.integers(4)]


def _two_belts(damping, velocities, laws, loads, bounds, omega):
    belts = zip(velocities, laws, loads, *zip(*bounds, strict=True), strict=True)
    return jb.Oscillator(damping, tuple(jb.Belt(*belt) for belt in belts), omega)


@functools.cache
def cases(seed: int, count: int = 40) -> list[tuple[jb.Oscillator, np.ndarray]]:
    """Oscillators and starts, every other one of round numbers."""
    rng = np.random.default_rng(seed)
    return [(round_numbers if i % 2 else any_numbers)(rng) for i in range(count)]


# --- the same oscillator, described otherwise -----------------------------------------------------


class Image(NamedTuple):
    """The same motion of another oscillator: its states are `sign` times, its belts in this order.

    order: for each of its belts the one that it was, -1 for one that does not count.
    """

    osc: jb.Oscillator
    sign: float = 1.0
    order: tuple[int, ...] = (0, 1)

    @property
    def columns(self) -> list[int]:
        """Where the belts are now."""
        return [self.order.index(belt) for belt in range(max(self.order) + 1)]


def changed(osc: jb.Oscillator, belts, **others) -> jb.Oscillator:
    return jb.Oscillator(
        others.get("damping", osc.damping), tuple(belts), others.get("omega", osc.omega)
    )


def changed_belt(belt: jb.Belt, **fields) -> jb.Belt:
    return jb.Belt(**({name: getattr(belt, name) for name in vars(belt)} | fields))


def reflected(osc: jb.Oscillator) -> Image:
    """x -> -x loops the belts round, and the contact intervals."""
    belts = [
        changed_belt(belt, velocity=-belt.velocity, lower=-belt.upper, upper=-belt.lower)
        for belt in osc.belts
    ]
    return Image(changed(osc, belts), sign=-1.0)


def exchanged(osc: jb.Oscillator) -> Image:
    return Image(changed(osc, osc.belts[::-1]), order=(1, 0))


def scaled(osc: jb.Oscillator) -> Image:
    """r = nu - omega x2 is the only place of omega: mu(r) is the same for a law in other units."""
    factor = 1.6
    belts = [
        changed_belt(
            belt,
            velocity=factor * belt.velocity,
            friction=jb.Conti(
                belt.friction.static,
                belt.friction.residual,
                belt.friction.steepness / factor,
                belt.friction.quadratic / factor**2,
            ),
        )
        for belt in osc.belts
    ]
    return Image(changed(osc, belts, omega=factor * osc.omega))


def with_idle_belt(osc: jb.Oscillator) -> Image:
    """A belt without load, as fast as one of the others, that comes and goes."""
    idle = changed_belt(osc.belts[1], load=0.0, lower=-0.4, upper=0.3)
    return Image(changed(osc, (*osc.belts, idle)), order=(0, 1, -1))


def with_idle_belt_at_rest(osc: jb.Oscillator) -> Image:
    idle = changed_belt(osc.belts[0], load=0.0, velocity=0.0)
    return Image(changed(osc, (*osc.belts, idle)), order=(0, 1, -1))


def split(osc: jb.Oscillator) -> Image:
    half = changed_belt(osc.belts[1], load=0.5 * osc.belts[1].load)
    return Image(changed(osc, (osc.belts[0], half, half)), order=(0, 1, 1))


def permuted(osc: jb.Oscillator) -> Image:
    """Three belts in another order."""
    order = (2, 0, 1)
    return Image(changed(osc, [osc.belts[belt] for belt in order]), order=order)


#: Of two belts.
IMAGES = {
    "reflected": reflected,
    "exchanged": exchanged,
    "scaled": scaled,
    "idle": with_idle_belt,
    "idle at rest": with_idle_belt_at_rest,
    "split": split,
}
#: More of the same at night.
seeds = pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 9))]
)
#: What a third belt, or one that presses with nothing, compiles nothing else needs.
OF_THEIR_OWN = "idle", "idle at rest", "split"
images_and_seeds = pytest.mark.parametrize(
    ("image_of", "seed"),
    [
        pytest.param(image_of, seed, id=f"{name}-{seed}", marks=slow)
        for name, image_of in IMAGES.items()
        for seed in range(9)
        for slow in [pytest.mark.slow(first=seed == 0) if seed or name in OF_THEIR_OWN else []]
    ],
)


# --- runs -----------------------------------------------------------------------------------------


class Event(NamedTuple):
    """What happened: its time and kind, the belt it is named after, and all that it concerns."""

    t: float
    kind: EventKind
    belt: int
    belts: frozenset[int]


class Run(NamedTuple):
    ts: np.ndarray
    ys: np.ndarray
    modes: np.ndarray
    events: list[Event]
    status: Status


def run(osc: jb.Oscillator, y0: np.ndarray, t0: float = 0.0, t1: float = T1, ts=None) -> Run:
    ts = np.linspace(t0, t1, SAMPLES) if ts is None else ts
    found = jb.simulate(osc, y0, t1, t0=t0, ts=ts, max_segments=ARCS)
    happened = found.events
    events = [
        Event(t, EventKind(kind), belt, _concerned(osc, kind, belt, x1))
        for t, kind, belt, x1 in zip(
            happened.t.tolist(),
            happened.kind.tolist(),
            happened.belt.tolist(),
            happened.y[:, 0].tolist(),
            strict=True,
        )
    ]
    return Run(ts, np.asarray(found.ys), np.asarray(found.modes), events, Status(int(found.status)))


def _concerned(osc: jb.Oscillator, kind: int, belt: int, x1: float) -> frozenset[int]:
    """Belts with the same edge or velocity: an event is named after the lowest that touches."""
    if kind == EventKind.EDGE:
        edges = [(float(one.lower), float(one.upper)) for one in osc.belts]
        at = min(edges[belt], key=lambda edge: abs(edge - x1))
        return frozenset(i for i, ends in enumerate(edges) if at in ends)
    velocity = float(osc.belts[belt].velocity)
    return frozenset(i for i, one in enumerate(osc.belts) if float(one.velocity) == velocity)


def as_before(found: Run, image: Image) -> Run:
    """The run of an image in terms of the oscillator that it is of."""
    events = [
        Event(t, kind, image.order[belt], frozenset(image.order[i] for i in belts) - {-1})
        for t, kind, belt, belts in found.events
        if image.order[belt] >= 0
    ]
    modes = image.sign * found.modes[:, image.columns]
    return Run(
        found.ts,
        image.sign * found.ys,
        modes,
        events,
        found.status,
    )


def same(a: Run, b: Run, since: float = -np.inf, till: float = np.inf) -> None:
    """Assert that two runs are one between two times, those themselves left out."""
    assert a.status == b.status
    one, two = ([e for e in r.events if since + AT_ONCE < e.t < till - AT_ONCE] for r in (a, b))
    assert [(e.kind, e.belts) for e in one] == [(e.kind, e.belts) for e in two]
    # A start at a tangency leaves it after the square root of rounding.
    times = [np.maximum([e.t for e in events], AT_ONCE) for events in (one, two)]
    np.testing.assert_allclose(*times, rtol=0, atol=CLOSE)
    inside = (a.ts > since) & (a.ts < till)
    np.testing.assert_allclose(a.ys[inside], b.ys[inside], rtol=0, atol=CLOSE)
    # At an event itself a mode is that before or that after it; at rest between the two sides of an
    # edge it is that of either.
    every = np.array([e.t for e in (*a.events, *b.events)])
    if a.status == Status.PSEUDO_FOCUS:
        inside &= a.ts < np.max(every, initial=a.ts[0])
    apart = inside & np.all(np.abs(a.ts[:, None] - every) > AT_ONCE, axis=1)
    np.testing.assert_array_equal(a.modes[apart], b.modes[apart])


@functools.cache
def original(seed: int, number: int) -> Run:
    return run(*cases(seed)[number])


def rests_on_an_edge(osc: jb.Oscillator, y0: np.ndarray) -> bool:
    """There the sides may push away or hold both: one is chosen, the right one, say."""
    edges = [edge for belt in osc.belts for edge in (float(belt.lower), float(belt.upper))]
    return y0[1] == 0 and y0[0] in edges


@pytest.mark.slow(first=True)
@images_and_seeds
def test_an_image_moves_as_it_does(image_of, seed):
    for number, (osc, y0) in enumerate(cases(seed)):
        if image_of is reflected and rests_on_an_edge(osc, y0):
            continue
        image = image_of(osc)
        same(original(seed, number), as_before(run(image.osc, image.sign * y0), image))


def pushes(osc: jb.Oscillator, edge: float) -> tuple[float, float]:
    """x2' of a mass at rest just left and just right of an edge; NaN where a belt holds it."""
    found = []
    for rightward in (False, True):
        pull = held = 0.0
        for belt in osc.belts:
            lower, upper, velocity = float(belt.lower), float(belt.upper), float(belt.velocity)
            if (lower <= edge < upper) if rightward else (lower < edge <= upper):
                friction = float(belt.load * belt.friction.mu(jnp.abs(belt.velocity)))
                pull += friction * np.sign(velocity)
                held += friction if velocity == 0 else 0.0
        found.append(pull - edge if abs(pull - edge) >= held else np.nan)
    return found[0], found[1]


def at_rest_on_an_edge() -> list[tuple[jb.Oscillator, np.ndarray]]:
    rng, law = np.random.default_rng(0), jb.Conti(1.0, 0.6, 10.0)
    # Held on the right, pushed there from the left.
    belts = jb.Belt(0.0, law, 2.0, lower=0.1), jb.Belt(0.25, law, 2.0, upper=0.1)
    every = [round_numbers(rng) for _ in range(100)]
    return [
        (jb.Oscillator(0.1, belts), np.array([0.1, 0.0])),
        *((osc, y0) for osc, y0 in every if rests_on_an_edge(osc, y0)),
    ]


@pytest.mark.slow(first=True)
def test_at_rest_on_an_edge_a_reflected_run_is_the_same():
    for osc, y0 in at_rest_on_an_edge():
        left, right = pushes(osc, y0[0])
        if left < 0 < right:
            continue  # it may leave to either side
        image = reflected(osc)
        a, b = run(osc, y0), as_before(run(image.osc, -y0), image)
        if np.isnan(left) and np.isnan(right):
            b = b._replace(modes=a.modes)  # held on both sides: no mode is the one
        same(a, b)


@pytest.mark.slow(first=True)
def test_a_belt_without_load_holds_nothing():
    law = jb.Conti(1.0, 0.6, 5.0)
    osc = jb.Oscillator(0.5, (jb.Belt(0.2, law, 0.5), jb.Belt(0.0, law, 0.0)))
    (rest,) = jb.equilibria(osc)
    found = run(osc, np.array([float(rest.x1), 0.0]))
    assert found.status == Status.OK
    dataset = lists.swept([osc], STARTS, observe="attractor")
    assert np.all(jb.decoded(dataset).kind == "equilibrium") and not np.any(dataset.sticks)


@pytest.mark.slow(first=True)
def test_an_orbit_comes_to_a_focus_beside_a_belt_without_load():
    osc, y0 = cases(4)[20]
    image = with_idle_belt_at_rest(osc)
    assert jb.find_cycle(osc, y0).status == Status.PSEUDO_FOCUS
    assert jb.find_cycle(image.osc, y0).status == Status.PSEUDO_FOCUS


def test_a_reflected_run_is_the_same_to_the_last_bit():
    for number, (osc, y0) in enumerate(cases(0)):
        if not rests_on_an_edge(osc, y0):
            image = reflected(osc)
            found = as_before(run(image.osc, -y0), image)
            np.testing.assert_array_equal(found.ys, original(0, number).ys)
            assert found.events == original(0, number).events


@pytest.mark.slow(first=True)
@seeds
def test_three_belts_in_another_order(seed):
    rng = np.random.default_rng(seed)
    for osc, y0 in (three_belts(rng) for _ in range(20)):
        image = permuted(osc)
        same(run(osc, y0), as_before(run(image.osc, y0), image))


def test_classes_with_edges_seen_in_a_mirror():
    rng = np.random.default_rng(0)
    for _ in range(10):
        nu0, nu1, sigma0, sigma1 = rng.integers(-15, 16, 4) / 20
        osc = jb.presets.class_d(nu0, nu1, *sorted((sigma0, sigma1)))
        mirrored = jb.presets.class_d(-nu1, -nu0, *sorted((-sigma0, -sigma1)))
        y0 = rng.normal(0, 1, 2)
        found = run(mirrored, -y0)
        same(run(osc, y0), as_before(found, Image(mirrored, -1.0, (1, 0))))


# --- runs in parts --------------------------------------------------------------------------------


def times_to_cut(whole: Run, rng: np.random.Generator) -> list[float]:
    """Any, those of events, and some within stick phases."""
    times = [event.t for event in whole.events]
    stuck = [
        0.5 * (event.t + end)
        for event, end in zip(whole.events, [*times[1:], T1], strict=False)
        if event.kind == EventKind.STICK
    ]
    some = [list(rng.permutation(these)[:2]) for these in (times, stuck)]
    return [rng.uniform(0.5, T1 - 0.5), *some[0], *some[1]]


@seeds
def test_a_run_goes_on_from_each_of_its_states(seed):
    rng = np.random.default_rng(seed)
    for number, (osc, y0) in enumerate(cases(seed)):
        whole = original(seed, number)
        for cut in times_to_cut(whole, rng):
            ts = np.sort(np.append(whole.ts[:-1], cut))
            ts = np.append(ts[1:], T1) if len(ts) < SAMPLES else ts
            there = run(osc, y0, ts=ts)
            state = there.ys[np.searchsorted(ts, cut)]
            same(run(osc, state, t0=cut, ts=np.maximum(whole.ts, cut)), whole, since=cut)


@seeds
def test_a_run_that_ends_anywhere_is_the_beginning_of_a_longer_one(seed):
    rng = np.random.default_rng(seed)
    for number, (osc, y0) in enumerate(cases(seed)):
        whole = original(seed, number)
        for end in times_to_cut(whole, rng):
            first = run(osc, y0, t1=end, ts=np.minimum(whole.ts, end))
            assert np.all(np.isfinite(first.ys))
            assert first.status in (Status.OK, whole.status)
            same(first._replace(status=whole.status), whole, till=end)
            assert len(first.events) - sum(e.t < end for e in whole.events) in (0, 1)


# --- cycles ---------------------------------------------------------------------------------------


#: Shooting takes a fixed number of steps. Its error is 1e-12 with the paper's constants; with loads
#: of 2, omega = 2 and p3 = 10 it comes to 1e-8 of the cycle's size.
SHOT = 1e-6


def numbers_of(cycle: jb.Cycle, image: Image | None = None) -> list[float]:
    """Of a cycle, or of the cycle of an image in terms of what it is an image of."""
    sign, columns = (image.sign, image.columns) if image else (1.0, slice(None))
    x1, x2 = (cycle.x1_min, cycle.x1_max), (cycle.x2_min, cycle.x2_max)
    extrema = [sign * float(value) for pair in (x1, x2) for value in pair[:: int(sign)]]
    sticks = np.asarray(cycle.stick_durations)[columns].tolist()
    return [float(cycle.status), float(cycle.period), float(cycle.multiplier), *sticks, *extrema]


two_belts_by_day = pytest.mark.parametrize(
    "image_of",
    [
        pytest.param(
            image_of,
            id=name,
            # A program for three belts takes as long to compile as all the rest.
            marks=[] if len(image_of(cases(0)[0][0]).order) == 2 else pytest.mark.slow,
        )
        for name, image_of in IMAGES.items()
    ],
)


@functools.cache
def original_cycle(seed: int, number: int) -> list[float]:
    return numbers_of(jb.find_cycle(*cases(seed)[number]))


@pytest.mark.slow
@seeds
@two_belts_by_day
def test_an_image_has_the_same_cycle(image_of, seed):
    for number, (osc, y0) in enumerate(cases(seed)):
        if image_of is reflected and rests_on_an_edge(osc, y0):
            continue
        expected = original_cycle(seed, number)
        image = image_of(osc)
        found = numbers_of(jb.find_cycle(image.osc, image.sign * y0), image)
        np.testing.assert_allclose(found, expected, rtol=SHOT, atol=SHOT)


# --- portraits and paths --------------------------------------------------------------------------


class Row(NamedTuple):
    """Something there is at an oscillator: what, and the numbers that an image has, too."""

    what: tuple[str, ...]
    numbers: tuple[float, ...]


def rows_of(portrait: jb.Portrait, sign: float = 1.0) -> list[Row]:
    """What a portrait tells, or that of an image in terms of what it is an image of."""
    rows, segments = [], []
    for rest in portrait.equilibria:
        ends = sorted(sign * float(x) for x in (rest.x1_lower, rest.x1_upper))
        kind = jb.EquilibriumKind(int(rest.kind)).name
        if kind == "SEGMENT":
            segments.append((*ends, bool(rest.stable)))
        else:
            stability = "stable" if rest.stable else "neutral" if rest.neutral else "unstable"
            rows.append(Row((kind, stability), tuple(ends)))
    # A segment is given in pieces, one between each two edges of any belt.
    segments.sort()
    whole: list[tuple[float, float, bool]] = []
    for low, high, stable in segments:
        if whole and abs(whole[-1][1] - low) < CLOSE:
            whole[-1] = (whole[-1][0], high, whole[-1][2] or stable)
        else:
            whole.append((low, high, stable))
    rows += [Row(("segment", str(stable)), (low, high)) for low, high, stable in whole]
    for name in ("cycles", "unstable"):
        for cycle in getattr(portrait, name):
            x1, x2 = (cycle.x1_min, cycle.x1_max), (cycle.x2_min, cycle.x2_max)
            extrema = [sign * float(v) for pair in (x1, x2) for v in pair[:: int(sign)]]
            rows.append(Row((name,), (*extrema, float(cycle.period))))
    for one in portrait.separatrices:
        left = (one.side == "left") == (sign > 0)
        x1, x2 = (sign * float(part) for part in one.point)
        rows.append(Row(("separatrix", str(one.stable), str(left), one.end), (x1, x2)))
    return sorted(rows)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("image_of", [*IMAGES.values()], ids=[*IMAGES])
def test_an_image_has_the_same_portrait(image_of, seed):
    for osc, _ in cases(seed, 12):
        image = image_of(osc)
        told, other = jb.portrait(osc), jb.portrait(image.osc)
        assert int(told.status) == int(other.status)
        expected, found = rows_of(told), rows_of(other, image.sign)
        assert [row.what for row in found] == [row.what for row in expected]
        for a, b in zip(expected, found, strict=True):
            np.testing.assert_allclose(b.numbers, a.numbers, rtol=SHOT, atol=SHOT)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ["reflected", "exchanged", "scaled"])
def test_an_image_changes_where_it_does(name, seed):
    """Along a load; a point may have the names of all that happens there at once."""
    for osc, _ in cases(seed, 4):

        def make(load, osc=osc):
            return changed(osc, (changed_belt(osc.belts[0], load=load), osc.belts[1]))

        expected = [float(point.value) for point in jb.scan(make, span=(0.25, 1.5))]
        found = jb.scan(lambda load: IMAGES[name](make(load)).osc, span=(0.25, 1.5))
        np.testing.assert_allclose([float(point.value) for point in found], expected, atol=1e-8)


# --- sweeps ---------------------------------------------------------------------------------------

#: Starts of the sweeps, the same seen in a mirror.
STARTS = {"x1": np.array([-2.0, -0.85, 0.0, 0.85, 2.0]), "x2": np.array([-1.0, 0.0, 1.0])}
#: Sweeps are integrated to 1e-8.
SWEPT = 1e-6


def swept(oscillators, observe: str, **axes):
    """All of some oscillators from all starts."""
    t1 = {"t1": 40.0} if observe == "final" else {}
    cases = {"case": np.arange(len(oscillators), dtype=float)}
    return lists.swept(oscillators, cases | STARTS | axes, observe=observe, **t1)


@functools.cache
def original_sweep(observe: str, seed: int):
    return swept([osc for osc, _ in cases(seed)], observe)


def sweeps_of(image_of, observe: str, seed: int):
    """The sweep, that of the images in the same order, and an image."""
    images = [image_of(osc) for osc, _ in cases(seed)]
    found = swept([image.osc for image in images], observe)
    if images[0].sign < 0:
        found = found.isel(x1=slice(None, None, -1), x2=slice(None, None, -1))
    return original_sweep(observe, seed), found, images[0]


def starts_at_rest_on_an_edge(seed: int) -> np.ndarray:
    """Which of the sweep's runs, [cases, x1, x2]."""
    grid = [
        [[rests_on_an_edge(osc, np.array([x1, x2])) for x2 in STARTS["x2"]] for x1 in STARTS["x1"]]
        for osc, _ in cases(seed)
    ]
    return np.array(grid)


@pytest.mark.slow(first=True)
@seeds
@two_belts_by_day
def test_an_image_ends_there_too(image_of, seed):
    whole, found, image = sweeps_of(image_of, "final", seed)
    counts = ~starts_at_rest_on_an_edge(seed) | (image_of is not reflected)
    # From rest on an edge that pushes to both sides either way is a solution; it goes right if it
    # can, and so does its reflection.
    same = counts.copy()
    for name in ("x1_end", "x2_end"):
        ends = image.sign * found[name].values[same]
        np.testing.assert_allclose(ends, whole[name].values[same], rtol=0, atol=SWEPT)
    np.testing.assert_array_equal(found.status.values[same], whole.status.values[same])
    if image_of is split:
        # The unit of length is another one, and so is the speed at which a run is captured by a
        # pseudo-focus; on which side of the edge it was before changes with every passage.
        counts &= whole.status.values != Status.PSEUDO_FOCUS
    modes = image.sign * found.mode_end.values[..., image.columns]
    np.testing.assert_array_equal(modes[counts], whole.mode_end.values[counts])
    if -1 not in image.order:
        np.testing.assert_array_equal(found.n_events.values[counts], whole.n_events.values[counts])


@pytest.mark.slow
@seeds
@two_belts_by_day
def test_an_image_has_the_same_attractors(image_of, seed):
    whole, found, image = sweeps_of(image_of, "attractor", seed)
    np.testing.assert_array_equal(found.kind, whole.kind)
    # Rest exactly on an edge is that of the side where it is reached, or that of the edge.
    moves = jb.decoded(whole).kind.values != "equilibrium"
    np.testing.assert_array_equal(found.status.values[moves], whole.status.values[moves])
    sticks = found.sticks.values[..., image.columns]
    np.testing.assert_array_equal(sticks, whole.sticks)
    durations = found.stick_duration.values[..., image.columns]
    close = dict(rtol=10 * SWEPT, atol=10 * SWEPT)
    np.testing.assert_allclose(durations, whole.stick_duration, **close)
    np.testing.assert_allclose(found.period, whole.period, **close)
    for name in ("x1", "x2"):
        ends = [f"{name}_min", f"{name}_max"]
        for end, other in zip(ends, ends[:: int(image.sign)], strict=True):
            np.testing.assert_allclose(image.sign * found[other], whole[end], **close)


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("observe", ["final", "attractor"])
def test_a_lane_does_not_know_of_the_others(observe, monkeypatch):
    oscillators, whole = [osc for osc, _ in cases(0)], original_sweep(observe, 0)
    backwards = swept(oscillators, observe, case=np.arange(len(oscillators), dtype=float)[::-1])
    assert backwards.isel(case=slice(None, None, -1)).equals(whole)
    # How signatures are numbered depends on which there are.
    alone = swept(oscillators, observe, case=np.array([7.0]), x1=np.array([2.0]))
    one = whole.sel(case=[7.0], x1=[2.0])
    assert alone.drop_vars("signature", errors="ignore").equals(
        one.drop_vars("signature", errors="ignore")
    )
    for threads in (1, 3):
        monkeypatch.setattr(sweep_threads, "workers", lambda threads=threads: threads)
        assert swept(oscillators, observe).equals(whole)
