"""The package's answer for a case against the engine's.

An answer is right if it is the engine's: sequence of events, final mode, status, and the states
within the tolerance. The effect of a tolerance is measured with the engine itself, by runs that are
disturbed by as much at every step and every event. Verdicts:

- "same": the answer is the engine's;
- "tolerance": the answer is not the engine's, but that of a run disturbed by the tolerance asked
  for: the tolerance does not determine the sequence of events;
- "corner": the run comes within 1e-9 of another outcome, where rounding decides, and the answer is
  that of a neighbour, whose parameters or start are moved by 1e-7;
- otherwise the difference, in a word or two.
"""

import itertools
from dataclasses import replace

import numpy as np

from . import derivatives, engine

#: Distance from another outcome below which a run is at a corner, and distance of its neighbours.
CORNER, NEIGHBOUR = 1e-9, 1e-7
#: Number of local errors that may add up beyond the effect that disturbed runs show.
STEPS = 30
#: Number of disturbed runs.
DISTURBED = 6
#: Statuses of runs that came to an end.
ORDINARY = (engine.OK, engine.STUCK_FOREVER, engine.PSEUDO_FOCUS)
#: The package's statuses of runs that take too many segments or steps, and the engine's.
GAVE_UP = (3, 4)
ENGINE_GAVE_UP = (engine.BUDGET, engine.CORNER, engine.STEPS)
#: Limits of events and steps in the engine's second try; ENOUGH: limit of events where the package
#: can be asked for a shorter run.
MANY_EVENTS, MANY_STEPS, ENOUGH = 2_000_000, 20_000_000, 50_000
GOOD = ("same", "tolerance", "corner")
#: Differences that the tolerance explains in a run with some ten thousand events.
UNSURE = ("state", "sequence", "more events", "fewer events")


def run(case, **options):
    return engine.simulate(case.oscillator, case.y0, case.T, **options)


def neighbours(case, by=NEIGHBOUR, joint=24, seed=0):
    """The case with the start or a parameter moved up or down, then many of them at random."""
    osc, n = case.oscillator, len(case.oscillator.belts)

    def moved(shifts):
        """shifts: of x1, x2, damping, omega; of each belt velocity, load, static, lower, upper."""
        belts = []
        for i, b in enumerate(osc.belts):
            velocity, load, static, lower, upper = shifts[4 + 5 * i : 9 + 5 * i]
            law = (b.law[0], b.law[1] + static, *b.law[2:])
            belts.append(
                replace(
                    b,
                    velocity=b.velocity + velocity,
                    law=law,
                    load=max(b.load + load, 0.0),
                    lower=b.lower + lower,
                    upper=b.upper + upper,
                )
            )
        new = replace(
            osc, damping=osc.damping + shifts[2], omega=osc.omega + shifts[3], belts=tuple(belts)
        )
        return replace(case, oscillator=new, y0=(case.y0[0] + shifts[0], case.y0[1] + shifts[1]))

    # Equal velocities of belts stay equal, and so do equal edges.
    def tied(shifts):
        groups = {}
        for i, b in enumerate(osc.belts):
            for j, value in ((0, b.velocity), (3, b.lower), (4, b.upper)):
                kind = "v" if j == 0 else "x"
                shifts[4 + 5 * i + j] = groups.setdefault((kind, value), shifts[4 + 5 * i + j])
        return shifts

    size = 4 + 5 * n
    for i, sign in itertools.product(range(size), (1.0, -1.0)):
        shifts = np.zeros(size)
        shifts[i] = sign * by
        yield moved(shifts)
    rng = np.random.default_rng(seed)
    for k in range(joint):
        shifts = by * rng.uniform(-1, 1, size)
        yield moved(tied(shifts) if k % 2 else shifts)
    for _ in range(joint):
        # A run may pass several corners, and agree without a shift at some of them.
        yield moved(by * rng.uniform(-1, 1, size) * (rng.uniform(size=size) < 0.3))


def spread(case, noise, reference, states):
    """Largest distance of the states of disturbed runs from `reference`, and these runs. noise:
    size of the disturbances. states(run): its states, or None if its sequence differs."""
    runs = [run(case, noise=noise, seed=i) for i in range(DISTURBED)]
    found = [states(r) for r in runs]
    far = [np.max(np.abs(f - reference)) for f in found if f is not None and np.size(f)]
    return max(far, default=0.0), runs


# ---------------------------------------------------------------- final states and sequences


def difference(case, told, mine, tol):
    """What differs between the package's answer `told` and a run of the engine, or None."""
    focus = engine.PSEUDO_FOCUS
    if told.status != mine.status and focus in (told.status, mine.status):
        # Both may be right: one recognises sooner than the other that the run converges.
        return _focus_difference(case, told, mine)
    if told.status in GAVE_UP and mine.status in ENGINE_GAVE_UP:
        return None  # too much for both, and both say so
    if told.status != mine.status:
        return f"status {told.status}, not {mine.status}"
    if mine.status == engine.NOT_FINITE:
        return None
    n = len(mine.kind)
    if told.status == focus:
        if told.events is not None:
            m = min(told.n_events, n)
            if tuple(e[1:3] for e in told.events[:m]) != mine.sequence[:m]:
                return "sequence"
        same = abs(told.x1 - mine.y_end[0]) < 1e-6 and abs(told.x2 - mine.y_end[1]) < 1e-6
        return None if same else "another focus"
    if told.n_events != n:
        return f"{'more' if told.n_events > n else 'fewer'} events"
    if told.events is not None and tuple(e[1:3] for e in told.events) != mine.sequence:
        return "sequence"
    if told.mode != tuple(mine.mode_end):
        return "mode"
    return _state_difference(case, told, mine, tol)


def _focus_difference(case, told, mine):
    """The difference, or None, where one ended in a pseudo-focus and the other not, or not yet."""
    if {told.status, mine.status} == {engine.PSEUDO_FOCUS, engine.STUCK_FOREVER}:
        # Loops around an edge of a belt at rest shrink below rounding; then the mass is at rest.
        same = abs(told.x1 - mine.y_end[0]) < 1e-6 and abs(told.x2 - mine.y_end[1]) < 1e-6
        return None if same else f"status {told.status}, not {mine.status}"
    longer = replace(case, T=10 * case.T)
    if told.status == engine.PSEUDO_FOCUS:
        lost = mine.status in ENGINE_GAVE_UP and abs(told.x1 - mine.y_end[0]) < 1e-6
        if lost and abs(mine.y_end[1]) < 1e-4:
            return None  # too many loops there for the engine, or too small ones
        if mine.status != engine.OK:
            return f"status {told.status}, not {mine.status}"
        later = run(longer, max_events=500_000)
        near = abs(mine.y_end[0] - told.x1) < 1e-2 and abs(mine.y_end[1]) < 5e-2
        same = later.status == engine.PSEUDO_FOCUS and abs(later.y_end[0] - told.x1) < 1e-6
        return None if same and near else "focus that is none"
    if told.status != engine.OK:
        return f"status {told.status}, not {mine.status}"
    honest = run(case, capture=False, max_events=2_000_000)
    if honest.status != engine.OK:
        honest = mine
    close = abs(told.x1 - honest.y_end[0]) < 1e-4 and abs(told.x2 - honest.y_end[1]) < 2e-2
    return None if close else "focus missed"


def _state_difference(case, told, mine, tol):
    # By the relative tolerance the error may grow with the size of the state.
    size = np.maximum(1.0, np.abs(mine.y_end))
    far = np.max(np.abs(np.array([told.x1, told.x2]) - mine.y_end) / size)
    # Not `>`: NaN is far.
    states = not far <= STEPS * tol
    if told.events is None or not told.events:
        if not states:
            return None
        d, _ = spread(
            case, tol, np.array(mine.y_end), lambda r: _same_kind(r, mine, np.array(r.y_end))
        )
        return None if far <= STEPS * (tol + d) else "state"
    rows = np.array([(e[0], e[3], e[4]) for e in told.events])
    table = np.column_stack([mine.t, mine.y])
    away = np.abs(rows - table)
    # An error in time is an error in the state divided by the speed towards the line.
    away[:, 0] *= np.minimum(_speeds(case, mine), 1.0)
    if not states and np.all(away <= STEPS * tol):
        return None
    d, runs = spread(
        case, tol, np.array(mine.y_end), lambda r: _same_kind(r, mine, np.array(r.y_end))
    )
    if not far <= STEPS * (tol + d):
        return "state"
    tables = [np.column_stack([r.t, r.y]) for r in runs if r.sequence == mine.sequence]
    room = np.max([np.abs(t - table) for t in tables], axis=0) if tables else 0.0
    return None if np.all(away <= STEPS * (tol + room)) else "event"


def _speeds(case, mine):
    """Speed [events] towards the boundary or edge of each event."""
    modes = [run(replace(case, T=1e-12)).mode_end, *mine.codes.tolist()]
    return np.array(
        [
            abs(y[1])
            if kind in (engine.EDGE, engine.SLIP)
            else abs(engine.force(case.oscillator, mode, *y))
            for kind, y, mode in zip(mine.kind, mine.y.tolist(), modes)
        ]
    )


def _same_kind(r, mine, value):
    return value if r.sequence == mine.sequence and r.status == mine.status else None


def judge(case, told, tol, again=None):
    """The verdict on a final state or a trajectory, and the engine's run.

    again(case, tol): the package's answer for a shorter run, where the engine cannot follow it all.
    """
    # Near grazing the engine's error grows as much as the package's, so it has to be smaller.
    mine = run(case, tol=min(1e-13, 0.01 * tol))
    if mine.status in (engine.BUDGET, engine.STEPS) and told.status in ORDINARY:
        events = ENOUGH if again else MANY_EVENTS
        mine = run(case, max_events=events, max_steps=MANY_STEPS)
        if again and mine.status == engine.BUDGET:
            shorter = replace(case, T=0.9 * mine.t_end)
            return judge(shorter, again(shorter, tol), tol)
    what = difference(case, told, mine, tol)
    if what is None:
        return "same", mine
    if _rest_alike(case, told, mine):
        return "tolerance", mine
    grazing = case.distance is not None  # closeness is intended there, and no excuse
    others = []
    for seed in range(DISTURBED):
        for noise in (tol,) if grazing else (tol, 10 * tol):
            disturbed = run(case, noise=noise, seed=seed)
            others += [disturbed] if noise == tol else []
            if disturbed.sequence != mine.sequence or disturbed.status != mine.status:
                if difference(case, told, disturbed, 10 * noise) is None:
                    return "tolerance", mine
    if grazing and _between(case, told, mine, tol):
        return "tolerance", mine
    if what in UNSURE and not grazing and _among(told, others, mine):
        return "tolerance", mine
    if not grazing and (mine.margin <= CORNER or mine.status == engine.CORNER):
        if told.status in ORDINARY and _rests_unstably(case):
            return "corner", mine
        if what == "sequence" and _in_turn(told.events) == _in_turn(_rows(mine)):
            if difference(case, replace(told, events=None), mine, tol) is None:
                return "corner", mine
        for other in neighbours(case):
            his = run(other)
            if his.status == engine.CORNER:
                continue
            if difference(other, told, his, max(tol, NEIGHBOUR)) is None:
                return "corner", mine
        return f"corner: {what}", mine
    return what, mine


def _among(told, others, mine):
    """Whether the answer's state and number of events lie within those of the disturbed runs, none
    of which has the engine's sequence.

    With some ten thousand events no tolerance determines their sequence or their number.
    """
    if any(run.sequence == mine.sequence for run in others):
        return False
    numbers = [len(run.kind) for run in (mine, *others)]
    if not min(numbers) <= told.n_events <= max(numbers):
        return False
    room = max(np.max(np.abs(np.array(run.y_end) - mine.y_end)) for run in others)
    return bool(np.max(np.abs(np.array([told.x1, told.x2]) - mine.y_end)) <= room)


def _between(case, told, mine, tol):
    """Whether runs disturbed by less than the tolerance have the answer's events, not the engine's,
    and states on all sides of the answer's: where errors grow a millionfold."""
    runs = [run(case, noise=0.1 * tol, seed=seed) for seed in range(4 * DISTURBED)]
    other = [r for r in runs if r.sequence != mine.sequence or r.status != mine.status]
    alike = [r for r in other if difference(case, told, r, tol) in (None, "state", "event")]
    ends = np.array([r.y_end for r in alike]).reshape(-1, 2)
    state = np.array([told.x1, told.x2])
    low, high = np.min(ends, axis=0, initial=np.inf), np.max(ends, axis=0, initial=-np.inf)
    return bool(np.all((low <= state) & (state <= high)))


def _rows(mine):
    return [(t, k, b, *y) for t, (k, b), y in zip(mine.t, mine.sequence, mine.y)]


def _in_turn(events):
    """Kinds and belts of events, grouped by instant, and sorted within each group."""
    found, instant = [], -np.inf
    for t, kind, belt, *_ in events:
        if t - instant > CORNER:
            found.append([])
        instant = t
        found[-1].append((int(kind), int(belt)))
    return [sorted(together) for together in found]


def _rest_alike(case, told, mine):
    """Whether both come to rest at one place after the same events, except events closer to it than
    any tolerance: there rounding decides which belt at rest or edge is passed last."""
    x1, x2 = mine.y_end
    pull = 0.0 if 0 in mine.mode_end else engine.force(case.oscillator, mine.mode_end, x1, x2)
    rests = max(abs(x2), abs(pull), abs(told.x2), abs(told.x1 - x1)) <= CORNER
    if not rests or told.status not in ORDINARY or mine.status not in ORDINARY:
        return False
    away = np.max(np.abs(mine.y - mine.y_end), axis=1, initial=0.0) > CORNER
    if told.events is None:
        return np.sum(away) <= told.n_events <= len(mine.kind) + 8
    far = [e[1:3] for e in told.events if max(abs(e[3] - x1), abs(e[4])) > CORNER]
    return far == [event for event, is_away in zip(mine.sequence, away) if is_away]


def _rests_unstably(case):
    """Whether a case starts on an unstable equilibrium, so that rounding decides when it leaves."""
    osc, (x1, x2) = case.oscillator, case.y0
    mode = run(replace(case, T=1e-9)).mode_end
    if x2 != 0 or 0 in mode or abs(engine.force(osc, mode, x1, 0.0)) > CORNER:
        return False
    h = 1e-6
    return engine.force(osc, mode, x1, h) > engine.force(osc, mode, x1, -h)


def judge_derivative(case, told, mine, direction, tol, again=None):
    """The verdict on d(final state) along a direction; mine: the engine's run of the case.

    Disturbed runs show the error that the tolerance allows, as for states. "tolerance": some
    pass other events, and the answer of `again` to a thousandth of the tolerance is right.
    """
    if case.distance is None and mine.margin <= CORNER:
        return _judge_beside(case, told, direction)
    right = derivatives.derivative(case, mine, direction)
    size = 1 + np.max(np.abs(right))
    if np.all(np.abs(told - right) <= 1e-7 * size):
        return "same", right
    others, leaves = [], False
    for i in range(DISTURBED):
        for noise in (tol, 10 * tol):
            # The start is disturbed, too: on an arc without events nothing else is.
            shift = noise * np.random.default_rng(i).uniform(-1, 1, 2) * (1 + np.abs(case.y0))
            other = replace(case, y0=tuple(np.array(case.y0) + shift))
            disturbed = run(other, noise=noise, seed=i)
            if disturbed.sequence == mine.sequence:
                others.append(derivatives.derivative(other, disturbed, direction))
            else:
                leaves = True
    # A run that is tangent to a boundary or edge has no derivative.
    others = [other for other in others if np.all(np.isfinite(other))]
    far = np.max(np.abs(np.array(others) - right)) if others else 0.0
    if np.all(np.abs(told - right) <= STEPS * far + 1e-7 * size):
        return "same", right
    if leaves and again:
        # The tolerance does not determine the events: the answer to a smaller one decides.
        closer = 1e-3 * tol
        found, _ = judge_derivative(case, again(case, direction, closer), mine, direction, closer)
        return ("tolerance" if found == "same" else "derivative"), right
    return "derivative", right


def judge_derivative_at_focus(case, told, run, direction):
    """The verdict on the derivative of a run that ends in a pseudo-focus, which is on an edge and
    moves with it, whatever the start; run: the package's answer."""
    bounds = [edge for belt in case.oscillator.belts for edge in (belt.lower, belt.upper)]
    moves = [edge for belt in direction[2] for edge in belt[2:]]
    right = np.array([next(d for b, d in zip(bounds, moves) if b == run.x1), 0.0])
    return ("same" if np.allclose(told, right, atol=1e-9) else "derivative at a focus"), right


def _judge_beside(case, told, direction):
    """The verdict on a derivative in a corner: it exists if those on both sides agree."""
    if _rests_unstably(case):
        return "corner", np.full(2, np.nan)
    both = []
    for by in (NEIGHBOUR, -NEIGHBOUR):
        other = derivatives.beside(case, direction, by)
        his = run(other)
        if his.status != engine.OK or his.t_end < case.T:
            return "corner", np.full(2, np.nan)
        both.append(derivatives.derivative(other, his, direction))
    right = np.mean(both, axis=0)
    apart, size = np.max(np.abs(both[0] - both[1])), 1 + np.max(np.abs(right))
    if not apart <= 1e-4 * size:
        return "corner", right
    good = np.all(np.abs(told - right) <= 1e-3 * size)
    return ("same" if good else "derivative in a corner"), right


# ---------------------------------------------------------------- attractors


#: A smaller motion repeats to the usual tolerance although it still shrinks.
SMALL = 1e-4


def label_difference(told, mine, slowest=1.0):
    """What differs between two labels, or None; slowest: the least speed of a stick phase."""
    if mine.kind == "undecided":
        return None if told.kind == "undecided" else "engine undecided"
    if told.kind == "undecided":
        return f"undecided, status {told.status}"
    if told.kind != mine.kind:
        return f"{told.kind}, not {mine.kind}"
    room = 1e-5
    if mine.kind != "cycle" and np.isnan(told.x1[0]):  # `find_cycle` gives none
        return None
    if mine.kind != "cycle":
        return None if abs(told.x1[0] - mine.x1[0]) <= room else f"another {mine.kind}"
    if told.loop is not None and told.loop != mine.loop:
        return "loop"
    states = [*zip(told.x1, mine.x1), *zip(told.x2, mine.x2)]
    times = [(told.period, mine.period), *zip(told.sticks, mine.sticks)]
    # Where a belt creeps, an error in a state is a large one in time.
    times = [(a * min(1.0, slowest), b * min(1.0, slowest)) for a, b in times]
    return None if all(abs(a - b) <= room for a, b in states + times) else "another cycle"


def judge_label(case, told, tol, again=None):
    """The verdict on a label, and the engine's label; again(case, tol): the package's at `tol`."""
    mine = engine.attractor(case.oscillator, case.y0)
    if mine.kind == "cycle" and max(np.ptp(mine.x1), np.ptp(mine.x2)) < SMALL:
        mine = engine.attractor(case.oscillator, case.y0, same=1e-13, at_rest=1e-8)
    speeds = [abs(b.velocity) / case.oscillator.omega for b in case.oscillator.belts]
    slowest = min((v for v in speeds if v > 0), default=1.0)
    what = label_difference(told, mine, slowest)
    if what is None:
        return "same", mine
    resting = ("equilibrium", "stuck")
    if told.kind in resting and mine.kind in resting:
        # At a node where a belt at rest could hold the mass, rounding decides whether it arrives.
        if abs(told.x1[0] - mine.x1[0]) <= CORNER:
            return "tolerance", mine
    if again and what == "another cycle":
        # Where a cycle attracts weakly, errors of the tolerance displace it further.
        if label_difference(again(case, 1e-3 * tol), mine, slowest) is None:
            return "tolerance", mine
    if case.distance is None and (mine.margin <= CORNER or mine.status == engine.CORNER):
        for other in neighbours(case, joint=12):
            his = engine.attractor(other.oscillator, other.y0)
            if his.kind != "undecided" and label_difference(told, his, slowest) is None:
                return "corner", mine
        return f"corner: {what}", mine
    return what, mine


#: Shift of an edge or boundary after which the derivative of a period is computed again: a cycle's
#: states are promised to 1e-10.
SHIFT = 1e-10
#: Other steps of differences, which show the accuracy of the engine's own derivative.
OTHER_STEPS = 1e-4, 1e-5


def judge_period_derivative(case, told, label, direction):
    """The verdict on d(period) of a cycle along a direction, and the engine's.

    Near grazing the derivative changes fast: the tolerance is its change as the edge or boundary
    moves by `SHIFT`. Where a belt creeps, the engine's derivative is good to a millionth only.
    """
    right = derivatives.of_period(case, label, direction)
    if np.isnan(told):
        return "no derivative, and a status that says so", right
    far = 0.0
    for by in (SHIFT, -SHIFT):
        last = case.oscillator.belts[-1]
        moved = replace(
            last,
            lower=last.lower + by,
            upper=last.upper + by,
            velocity=last.velocity + (by if last.load == 0 else 0.0),
        )
        belts = (*case.oscillator.belts[:-1], moved)
        near = replace(case, oscillator=replace(case.oscillator, belts=belts))
        other = engine.attractor(near.oscillator, near.y0)
        if other.loop == label.loop:
            far = max(far, abs(derivatives.of_period(near, other, direction) - right))
    room = STEPS * far + 1e-7 * (1 + abs(right))
    if abs(told - right) > room:
        others = [derivatives.of_period(case, label, direction, step) for step in OTHER_STEPS]
        room += 3 * max(abs(other - right) for other in others)
    return ("same" if abs(told - right) <= room else "derivative of the period"), right
