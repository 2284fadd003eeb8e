"""Campaigns: `python -m tests.campaign WHAT`, WHAT being final, simulate, derivatives, attractors,
grazing, paths, refine, portraits, shocks, fractions or maps."""

import argparse
import functools
import json
import os
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np


def main(arguments=None):
    options = _parser().parse_args(arguments)
    import jax

    jax.config.update("jax_enable_x64", True)
    from . import cases, compare, fractions, maps, package, paths, portraits, refine, shocks

    if options.what == "paths":
        return paths.run(options.seed, options.paths)
    if options.what == "refine":
        return refine.run(options.seed, options.runs)
    if options.what == "portraits":
        return portraits.run(options.seed, options.runs)
    if options.what == "shocks":
        return shocks.run(options.seed, options.runs, verbose=options.verbose)
    if options.what == "fractions":
        return fractions.run(options.seed, options.runs, options.threads)
    if options.what == "maps":
        return maps.run(options.show or 20)
    rng = np.random.default_rng(options.seed)
    began = time.monotonic()
    verdicts, disagreements, right, done = Counter(), [], [], 0
    report = open(options.report, "a", encoding="utf-8") if options.report else None
    with ThreadPoolExecutor(options.threads) as pool:
        for batch in _batches(cases, rng, options):
            told = _ask(package, batch, options)
            labels = options.what == "attractors" or options.by == "find_cycle"
            judge = compare.judge_label if labels else compare.judge
            if labels and options.by != "find_cycle":
                judge = functools.partial(
                    judge, again=lambda case, tol: package.labels([case], tol)[0]
                )

            def one(pair, judge=judge):
                return judge(*pair, options.tol)

            for case, answer, (verdict, mine) in zip(batch, told, pool.map(one, zip(batch, told))):
                verdicts[case.kind, verdict] += 1
                if verdict == "same" and _has_derivatives(mine, answer, options):
                    right.append((case, mine, answer))
                if verdict in ("same", "tolerance") or (
                    verdict == "corner" and not options.corners
                ):
                    continue
                line = dict(
                    what=options.what,
                    verdict=verdict,
                    tol=options.tol,
                    told=_plain(answer),
                    engine=_plain(mine),
                    case=case.to_json(),
                    code=package.as_code(case),
                )
                disagreements.append(line)
                if report:
                    print(json.dumps(line), file=report, flush=True)
            if right:
                judge_all = _differentiate_cycles if labels else _differentiate
                judge_all(right, verdicts, disagreements, rng, options)
                right.clear()
            done += len(batch)
            if options.verbose:
                bad = sum(n for (_, v), n in verdicts.items() if v not in compare.GOOD)
                seconds = time.monotonic() - began
                print(f"{done:,} runs, {bad} wrong, {seconds:.0f} s", file=sys.stderr, flush=True)
    rows = _rows(verdicts, compare.GOOD, options)
    print("\n".join(rows))
    print(f"seed {options.seed}, {time.monotonic() - began:.0f} s")
    for (kind, verdict), n in verdicts.most_common():
        if verdict not in compare.GOOD:
            print(f"{n} {kind}: {verdict}")
    if options.table:
        _put_rows(options.table, rows)
    if options.show:
        shown = Counter()
        for line in disagreements:
            shown[line["verdict"]] += 1
            if shown[line["verdict"]] <= options.show:
                print(f"\n{line['verdict']}: {line['code']}\n  told   {line['told']}")
                print(f"  engine {line['engine']}")
    return int(any(v not in compare.GOOD for _, v in verdicts))


def _parser():
    parser = argparse.ArgumentParser(prog="python -m tests.campaign", description=__doc__)
    parser.add_argument(
        "what",
        choices=(
            *("final", "simulate", "derivatives", "attractors", "grazing", "paths", "refine"),
            *("portraits", "shocks", "fractions", "maps"),
        ),
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--paths", type=int, default=20)
    parser.add_argument("--rational-share", type=float, default=0.5)
    parser.add_argument("--extreme-share", type=float, default=0.0)
    parser.add_argument(
        "--by",
        choices=("simulate", "sweep", "find_cycle"),
        default="simulate",
        help="who is asked to graze, or for derivatives",
    )
    parser.add_argument("--programs", type=int, default=9, help="structures of laws and edges")
    parser.add_argument("--structure", type=int, help="only this one of them")
    parser.add_argument("--span", type=float, default=50.0, help="time that a run takes")
    parser.add_argument("--tol", type=float, help="rtol and atol; default: the package's")
    parser.add_argument("--batch", type=int, default=4096, help="runs in one call")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--report", type=Path, help="file for JSON lines, one a disagreement")
    parser.add_argument("--table", type=Path, help="page to put the results' rows in")
    parser.add_argument("--corners", action="store_true", help="report excused corners, too")
    parser.add_argument("--show", type=int, default=0, help="print so many of each kind")
    parser.add_argument("--verbose", action="store_true")
    return _Defaults(parser)


class _Defaults:
    """The parser, with the package's own tolerance where none is given."""

    def __init__(self, parser):
        self.parser = parser

    def parse_args(self, arguments):
        options = self.parser.parse_args(arguments)
        if options.tol is None:
            options.tol = 1e-10 if options.what in ("simulate", "derivatives", "grazing") else 1e-8
        return options


def _batches(cases, rng, options):
    """Lists of cases, one structure each."""
    if options.what == "grazing":
        yield from cases.grazing_batches(rng, options)
        return
    structures = cases.structures(rng, options.programs)
    if options.structure is not None:
        structures = [structures[options.structure]]
    # Half of them in the commonest structure of two belts with edges.
    shares = np.array([2.0 / (1 + i) for i in range(len(structures))])
    counts = np.ceil(options.runs * shares / shares.sum()).astype(int)
    for structure, count in zip(structures, counts):
        for first in range(0, count, options.batch):
            yield [
                _maker(cases, rng, options)(rng, structure, options.span)
                for _ in range(min(options.batch, count - first))
            ]


def _maker(cases, rng, options):
    chance = rng.random()
    if chance < options.rational_share:
        return cases.rational_case
    if chance < options.rational_share + options.extreme_share:
        return cases.extreme_case
    return cases.random_case


def _ask(package, batch, options):
    if options.by == "find_cycle":
        return package.cycles(batch)
    if options.what == "final" or options.by == "sweep":
        return package.finals(batch, options.tol)
    if options.what == "attractors":
        return package.labels(batch, options.tol)
    return package.simulated(batch, options.tol)


def _has_derivatives(mine, run, options):
    """Whether derivatives are asked of a run, `mine` the engine's: near grazing always, else where
    it goes on until T, or to a pseudo-focus, and comes near to no other outcome, or to a corner."""
    from . import compare, engine

    if options.what == "derivatives":
        clear = mine.margin > 1e-6 or mine.margin <= compare.CORNER
        lasts = mine.t_end == options.span and mine.status == engine.OK
        return (lasts or run.status == engine.PSEUDO_FOCUS) and clear
    return options.what == "grazing"


def _differentiate(runs, verdicts, disagreements, rng, options):
    """Derivatives of the runs that were right, each along a direction of its own."""
    from . import compare, derivatives, engine, package

    cases = [case for case, _, _ in runs]
    along = [derivatives.directions(case, rng) for case in cases]
    told = package.derivatives(cases, along, options.tol, options.by)

    def again(case, direction, tol):
        return package.derivatives([case], [direction], tol, options.by)[0]

    for (case, mine, run), direction, answer in zip(runs, along, told):
        if run.status == engine.PSEUDO_FOCUS:
            judged = compare.judge_derivative_at_focus(case, answer, run, direction)
        else:
            judged = compare.judge_derivative(case, answer, mine, direction, options.tol, again)
        _count_derivative(case, direction, answer, judged, verdicts, disagreements, options)


def _differentiate_cycles(runs, verdicts, disagreements, rng, options):
    """Derivatives of the periods of the cycles that were right."""
    from . import compare, derivatives, package

    runs = [(case, mine) for case, mine, _ in runs if mine.kind == "cycle"]
    along = [derivatives.directions(case, rng) for case, _ in runs]
    told = package.period_derivatives([case for case, _ in runs], along)
    for (case, mine), direction, answer in zip(runs, along, told):
        judged = compare.judge_period_derivative(case, answer, mine, direction)
        _count_derivative(case, direction, answer, judged, verdicts, disagreements, options)


def _count_derivative(case, direction, told, judged, verdicts, disagreements, options):
    """Count a verdict on a derivative, and report it where it is not right."""
    from . import package

    verdict, right = judged
    verdicts[f"{case.kind}, derivative", verdict] += 1
    if verdict != "same":
        line = dict(
            what="derivative",
            verdict=verdict,
            tol=options.tol,
            told=np.asarray(told).tolist(),
            engine=np.asarray(right).tolist(),
            direction=direction,
            case=case.to_json(),
            code=package.as_code(case),
        )
        _report(line, disagreements, options)


def _report(line, disagreements, options):
    disagreements.append(line)
    if options.report:
        with open(options.report, "a", encoding="utf-8") as file:
            print(json.dumps(line), file=file)


def _plain(value):
    """A result as JSON takes it, without the arrays of events beyond the first few."""
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


def _rows(verdicts, good, options):
    """The rows of the table in `docs/checked.md`."""
    asked = options.what in ("grazing", "derivatives")
    what = options.what + (f", {options.by}" if asked else "")
    rows = []
    for kind in sorted({kind for kind, _ in verdicts}):
        counts = {v: n for (k, v), n in verdicts.items() if k == kind}
        wrong = sum(n for v, n in counts.items() if v not in good)
        numbers = (sum(counts.values()), counts.get("tolerance", 0), counts.get("corner", 0), wrong)
        runs, tolerance, corner, wrong = (f"{n:,}" for n in numbers)
        rows.append(
            f"| {what} | {kind} | {runs} | {options.tol:g} | {tolerance} | {corner} | {wrong} |"
        )
    return rows


def _put_rows(path, rows):
    """Put rows before the mark in the page, in place of those of the same campaign."""

    def key(row):
        cells = row.split(" | ")
        return (cells[0], cells[1], cells[3]) if len(cells) == 7 else row

    new = {key(row) for row in rows}
    lines = [x for x in path.read_text(encoding="utf-8").splitlines() if key(x) not in new]
    place = lines.index("<!-- campaigns -->")
    path.write_text("\n".join([*lines[:place], *rows, *lines[place:], ""]), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
