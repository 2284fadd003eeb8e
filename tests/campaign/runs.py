"""Runs: final states, trajectories, their derivatives and labels against the engine's.

A case of this campaign is a batch of runs of one structure, which is one call of the package.
"""

import functools
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from . import cases, compare, derivatives, engine, package, units
from .outcome import Outcome

#: Runs in one batch; those on round numbers share their units, and so do the others.
BATCH = 512


def settings(options):
    names = ["runs", "by", "structure", "tol", "extreme_share"]
    # Files of results from before these options existed lack these settings.
    names += [name for name in ("heavy", "regime") if getattr(options, name)]
    return {name: getattr(options, name) for name in names}


def numbers(options):
    return range(len(_batches(options)))


def outcome(options, number):
    structure, count = _batches(options)[number]
    rng = np.random.default_rng((options.seed, number))
    batch = [_case(rng, structure, options) for _ in range(count)]
    one = Outcome(f"{count} runs")
    # Only powers of two as units keep round numbers round, and distances of 1e-11 exact.
    for is_exact in (True, False):
        own = units.drawn(np.random.default_rng((options.seed, number, is_exact)), exact=is_exact)
        some = [replace(c, units=own) for c in batch if _wants_exact(c) == is_exact]
        if some:
            _compare(some, one, rng, options)
    return one


def _wants_exact(case):
    return case.distance is not None or case.kind.endswith("rational")


def _compare(batch, one, rng, options):
    """Compares runs of one call."""
    labels = options.what == "attractors" or options.by == "find_cycle"
    judge = compare.judge_label if labels else compare.judge
    if labels and options.by != "find_cycle":
        judge = functools.partial(judge, again=lambda case, tol: package.labels([case], tol)[0])
    elif options.heavy and options.what == "final":
        judge = functools.partial(judge, again=lambda case, tol: package.finals([case], tol)[0])
    right, told = [], _ask(batch, options)
    for case, answer, (verdict, mine) in zip(batch, told, _judged(judge, batch, told, options)):
        _count(one, options, case.kind, verdict, case, answer, mine)
        if verdict == "same" and _has_derivatives(mine, answer, options):
            right.append((case, mine, answer))
    if right and labels:
        _differentiate_cycles(one, right, rng, options)
    elif right:
        _differentiate(one, right, rng, options)


def said(counts, largest):
    """Rows of the table in `docs/checked.md`, then counts of wrong verdicts and of derivatives."""
    verdicts = [(*name.split("|"), n) for name, n in counts.items() if "|" in name]
    rows = []
    for kind in sorted({kind for kind, *_ in verdicts}):
        some = [(v, n, what, tol) for k, v, what, tol, n in verdicts if k == kind]
        _, _, what, tol = some[0]
        parts = [
            sum(n for _, n, *_ in some),
            sum(n for v, n, *_ in some if v == "tolerance"),
            sum(n for v, n, *_ in some if v == "corner"),
            sum(n for v, n, *_ in some if v not in compare.GOOD),
        ]
        runs, tolerance, corner, wrong = (f"{n:,}" for n in parts)
        rows.append(f"| {what} | {kind} | {runs} | {tol} | {tolerance} | {corner} | {wrong} |")
    rows += [f"{n} {kind}: {v}" for kind, v, _, _, n in verdicts if v not in compare.GOOD]
    if counts["derivatives"]:
        # The others are right within the tolerance of the runs.
        rows.append(f"{counts['derivatives to 1e-7']} of {counts['derivatives']} to 1e-7")
    return rows


def _batches(options):
    """Pairs of a structure and a number of runs."""
    if options.what == "grazing" and options.by == "find_cycle":
        return [(None, min(BATCH, options.runs - n)) for n in range(0, options.runs, BATCH)]
    structures = cases.structures(np.random.default_rng(options.seed), cases.STRUCTURES)
    structures = cases.REGIMES.get(options.regime, structures)
    # The first structures have the most runs; for grazing all have equally many.
    shares = np.array([2.0 / (1 + i) for i in range(len(structures))])
    if options.what == "grazing":
        shares[:] = 1.0
    if options.structure is not None:
        structures = structures[options.structure : options.structure + 1]
        shares = np.ones(1)
    counts = np.ceil(options.runs * shares / shares.sum()).astype(int).tolist()
    return [
        (structure, min(BATCH, count - first))
        for structure, count in zip(structures, counts)
        for first in range(0, count, BATCH)
    ]


def _case(rng, structure, options):
    if options.what == "grazing":
        smallest = 1e-11 if options.tol <= 1e-12 else 1e-8
        if options.by == "find_cycle":
            return cases.grazing_cycle(rng, smallest)
        return cases.grazing_case(rng, structure, smallest)
    if options.heavy:
        return cases.heavy_case(rng, structure)
    if options.regime:
        return cases.regime_case(rng, structure, options.regime)
    chance = rng.random()
    if chance < 0.5:
        return cases.rational_case(rng, structure)
    if chance < 0.5 + options.extreme_share:
        return cases.extreme_case(rng, structure)
    return cases.random_case(rng, structure)


def _ask(batch, options):
    if options.by == "find_cycle":
        return package.cycles(batch)
    if options.what == "final" or options.by == "sweep":
        return package.finals(batch, options.tol)
    if options.what == "attractors":
        return package.labels(batch, options.tol)
    return package.simulated(batch, options.tol)


def _judged(judge, batch, told, options):
    """The verdicts and the engine's results, judged on several threads."""
    pool = ThreadPoolExecutor(options.threads)
    try:
        return list(pool.map(lambda case, answer: judge(case, answer, options.tol), batch, told))
    finally:
        # After an interrupt, cases that have not begun are dropped.
        pool.shutdown(cancel_futures=True)


def _count(one, options, kind, verdict, case, told, right, **more):
    """Counts a verdict; a wrong one is recorded with its whole case."""
    asked = options.what in ("grazing", "derivatives")
    what = options.what + (f", {options.by}" if asked else "")
    one.counts[f"{kind}|{verdict}|{what}|{options.tol:g}"] += 1
    if verdict not in compare.GOOD:
        told = dict(told=_plain(told), engine=_plain(right), case=case.to_json(), **more)
        one.wrong.append(f"{verdict}: {package.as_code(case)}\n  {json.dumps(told)}")


def _plain(value):
    """A result in types that JSON has, with the first few events only."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    out = {}
    for name, v in vars(value).items():
        if name in ("t", "kind", "belt", "y", "codes") and isinstance(v, np.ndarray):
            continue
        out[name] = list(v[:12]) if isinstance(v, tuple) else v
    if hasattr(value, "sequence"):
        rows = zip(value.t.tolist(), value.sequence, value.y.tolist())
        out["n_events"] = len(value.kind)
        out["events"] = [(t, *event, *y) for t, event, y in list(rows)[:12]]
    return out


# --- derivatives ----------------------------------------------------------------------------------


def _has_derivatives(mine, run, options):
    """Whether derivatives of a run are compared; mine: the engine's run. Near grazing always, else
    if it lasts until T or ends in a pseudo-focus, and its margin is large, or that of a corner."""
    if options.what == "derivatives" and options.by == "find_cycle":
        return mine.kind == "cycle" and mine.margin > 1e-6
    if options.what == "derivatives":
        clear = mine.margin > 1e-6 or mine.margin <= compare.CORNER
        lasts = mine.t_end == cases.Case.T and mine.status == engine.OK
        return (lasts or run.status == engine.PSEUDO_FOCUS) and clear
    return options.what == "grazing"


def _differentiate(one, runs, rng, options):
    """Compares derivatives of the runs that were right, each along its own direction."""
    some = [case for case, _, _ in runs]
    along = [derivatives.directions(case, rng) for case in some]
    told = package.derivatives(some, along, options.tol, options.by)

    def again(case, direction, tol):
        return package.derivatives([case], [direction], tol, options.by)[0]

    for (case, mine, run), direction, answer in zip(runs, along, told):
        if run.status == engine.PSEUDO_FOCUS:
            judged = compare.judge_derivative_at_focus(case, answer, run, direction)
        else:
            judged = compare.judge_derivative(case, answer, mine, direction, options.tol, again)
        _count_derivative(one, options, case, direction, answer, judged)


def _differentiate_cycles(one, runs, rng, options):
    """Compares derivatives of the periods of the cycles that were right."""
    runs = [(case, mine) for case, mine, _ in runs if mine.kind == "cycle"]
    along = [derivatives.directions(case, rng) for case, _ in runs]
    told = package.period_derivatives([case for case, _ in runs], along)
    for (case, mine), direction, answer in zip(runs, along, told):
        judged = compare.judge_period_derivative(case, answer, mine, direction)
        _count_derivative(one, options, case, direction, answer, judged)


def _count_derivative(one, options, case, direction, answer, judged):
    verdict, right = judged
    answer, right = np.asarray(answer), np.asarray(right)
    kind = f"{case.kind}, derivative"
    _count(one, options, kind, verdict, case, answer, right, direction=direction)
    error = float(np.max(np.abs(answer - right) / (1 + np.max(np.abs(right)))))
    if verdict == "same" and np.isfinite(error):
        one.counts["derivatives"] += 1
        one.counts["derivatives to 1e-7"] += error <= 1e-7
