"""Campaigns: `python -m tests.campaign WHAT`.

Each case is told as soon as it does not agree, the others now and then. Ctrl-C, or a signal to
terminate (`timeout`), ends a campaign with a summary of what is done. With `--results FILE` the
same call goes on from there: the file has a line of JSON for each case, with the commit that it
ran on.
"""

import argparse
import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import time
import traceback
from pathlib import Path

from .cases import REGIMES, STRUCTURES
from .outcome import Outcome, part, summed

#: Module of each campaign.
CAMPAIGNS = {
    **dict.fromkeys(("final", "simulate", "derivatives", "attractors", "grazing"), "runs"),
    **{
        name: name
        for name in (
            *("paths", "refine", "portraits", "shocks", "fractions", "maps", "steep"),
            *("coverage", "slopes", "branches", "phases", "curves", "designs", "multipliers"),
        )
    },
    "forced-sweep": "forced_sweeps",
    "forced": "forced_runs",
}
#: Options that each campaign knows, besides `--results`.
PLAIN = frozenset({"seed", "runs"})
RUNS = PLAIN | {"threads", "extreme_share", "heavy", "regime", "structure", "tol", "table"}
KNOWN = {
    **dict.fromkeys(("paths", "refine", "portraits", "shocks"), PLAIN),
    "maps": frozenset(),
    **dict.fromkeys(
        ("steep", "coverage", "slopes", "branches", "phases", "curves", "designs", "multipliers"),
        PLAIN,
    ),
    "fractions": PLAIN | {"threads"},
    "forced-sweep": PLAIN | {"threads", "structure", "tol"},
    "forced": PLAIN | {"threads", "structure", "tol"},
    **dict.fromkeys(("final", "simulate", "attractors"), RUNS),
    "derivatives": RUNS | {"by"},
    "grazing": RUNS - {"extreme_share", "heavy", "regime"} | {"by"},
}
#: Default values of options.
DEFAULTS = dict(
    seed=0,
    runs=2000,
    extreme_share=0.0,
    heavy=False,
    regime=None,
    by="simulate",
    threads=os.cpu_count(),
)
#: Seconds between two lines of progress while all cases agree.
QUIET = 15.0
#: Most lines printed for one case; the file of results has all of them.
SHOWN = 6


def main(arguments=None):
    options = _parsed(arguments)
    import jax

    jax.config.update("jax_enable_x64", True)
    campaign = importlib.import_module(f".{CAMPAIGNS[options.what]}", __package__)
    header = dict(what=options.what, seed=options.seed, **part(campaign, "settings")(options))
    results = Results(options.results, header)
    numbers = part(campaign, "numbers")(options)
    began = time.monotonic()
    with _stopping() as was_asked:
        _go_through(campaign, options, numbers, results, was_asked)
    done = [results.outcomes[n] for n in numbers if n in results.outcomes]
    wrong = sum(bool(one.wrong) for one in done)
    counts, largest = summed(done)
    said = part(campaign, "said")(counts, largest)
    print(*said, sep="\n")
    print(
        f"{options.what}, seed {options.seed}: {len(done)} of {len(numbers)} cases, {wrong} wrong; "
        f"{time.monotonic() - began:.0f} s; commit {', '.join(sorted(results.commits))}"
    )
    if options.table:
        put_rows(options.table, said)
    return int(wrong > 0 or len(done) < len(numbers) or not part(campaign, "holds")(counts))


def _go_through(campaign, options, numbers, results, was_asked):
    """Compares the cases that have no result yet."""
    began = told = time.monotonic()
    wrong = 0
    for number in numbers:
        if number in results.outcomes:
            continue
        try:
            one = campaign.outcome(options, number)
        except Exception:
            if was_asked():
                raise KeyboardInterrupt from None
            one = Outcome("raises", wrong=[traceback.format_exc()])
        results.add(number, one)
        wrong += bool(one.wrong)
        now = time.monotonic()
        if one.wrong or one.notes or now - told > QUIET:
            told = now
            print(
                f"case {number} of {len(numbers)}, {now - began:.0f} s, {wrong} wrong: {one.line}"
            )
            lines = [*one.wrong, *one.notes]
            print(*lines[:SHOWN], sep="\n", end="\n" if lines else "", flush=True)
            if len(lines) > SHOWN:
                print(f"and {len(lines) - SHOWN} more", flush=True)


@contextlib.contextmanager
def _stopping():
    """Context that Ctrl-C or a signal to terminate ends, after which the program goes on; yields a
    function that says whether there was such a signal.

    Inside of the engine's compiled code the interrupt becomes another exception.
    """
    asked = []

    def stop(number, _):
        asked.append(number)
        raise KeyboardInterrupt

    signals = signal.SIGINT, signal.SIGTERM
    before = [signal.signal(one, stop) for one in signals]
    try:
        yield lambda: bool(asked)
    except KeyboardInterrupt:
        print("stopped; this is what is done:", flush=True)
    finally:
        for one, handler in zip(signals, before):
            signal.signal(one, handler)


class Results:
    """Outcomes by the number of their case; path: a file that keeps them, or None."""

    def __init__(self, path, header):
        self.path, self.commit = path, _commit()
        self.outcomes, self.commits = {}, {self.commit}
        if path is None:
            return
        rows = _rows(path) if path.exists() else []
        if rows and rows[0] != json.loads(json.dumps(header)):
            raise SystemExit(f"{path} is of another campaign: {rows[0]}, not {header}")
        for row in rows[1:]:
            number, commit = row.pop("number"), row.pop("commit")
            self.outcomes[number] = Outcome(**row)
            self.commits.add(commit)
        # The file is written again, because its last line may have been cut.
        lines = path.read_text(encoding="utf-8").splitlines()[: len(rows)] if rows else []
        lines = lines or [json.dumps(header)]
        path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")

    def add(self, number, outcome):
        self.outcomes[number] = outcome
        if self.path is not None:
            row = dict(number=number, commit=self.commit, **outcome.to_json())
            with open(self.path, "a", encoding="utf-8") as file:
                print(json.dumps(row), file=file)


def _rows(path):
    """Parsed lines of a file of results, without the last one if it was cut."""
    rows = []
    lines = path.read_text(encoding="utf-8").splitlines()
    for line in lines:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            if line is not lines[-1]:
                raise
    return rows


def _commit():
    """The commit that is checked out, marked "-dirty" if files differ from it."""
    asked = ["git", "describe", "--always", "--dirty", "--exclude", "*"]
    told = subprocess.run(asked, cwd=Path(__file__).parent, capture_output=True, text=True)
    return told.stdout.strip() or "unknown"


def _parsed(arguments):
    """Options of the command line, defaults included; refuses those that the campaign has not."""
    parser = _parser()
    options = parser.parse_args(arguments)
    what = options.what
    told = {name for name, value in vars(options).items() if value is not None}
    for name in sorted(told - {"what", "results"} - KNOWN[what]):
        parser.error(f"--{name.replace('_', '-')}: {what} does not know it")
    if what == "grazing" and options.by == "find_cycle" and options.structure is not None:
        parser.error("--structure: cycles that graze have none")
    for name, value in DEFAULTS.items():
        if name not in told:
            setattr(options, name, value)
    if options.tol is None:
        options.tol = 1e-10 if what in ("simulate", "forced", "derivatives", "grazing") else 1e-8
    return options


def _whole(least, below=None):
    """Type of an argument: whole numbers from `least` on, and below `below` unless that is None."""

    def whole(text):
        value = int(text)
        if value < least or (below is not None and value >= below):
            expected = f"{least} or more" if below is None else f"{least} to {below - 1}"
            raise argparse.ArgumentTypeError(f"expected {expected}, got {value}")
        return value

    return whole


def _share(text):
    value = float(text)
    if not 0 <= value <= 0.5:
        raise argparse.ArgumentTypeError(f"expected 0 to 0.5, got {value}")
    return value


def _positive(text):
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a positive number, got {value}")
    return value


def _parser():
    parser = argparse.ArgumentParser(
        prog="python -m tests.campaign",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=CAMPAIGNS)
    parser.add_argument("--seed", type=_whole(0))
    parser.add_argument(
        "--runs",
        type=_whole(1),
        help="runs, paths, portraits or shocks; of fractions the engine's starts (2000)",
    )
    parser.add_argument("--results", type=Path, help="file of results, which a later call goes on")
    parser.add_argument("--extreme-share", type=_share, help="of runs, of 0.5 at random (0)")
    parser.add_argument(
        "--heavy",
        action="store_const",
        const=True,
        help="loads of 1e-6 to 1e6 beside one another, half of the cases on round numbers",
    )
    parser.add_argument(
        "--regime",
        choices=REGIMES,
        help="four and six belts; laws with a jump; a Stribeck speed of 1e-4 of the belt; friction "
        "that grows beyond the static limit",
    )
    parser.add_argument(
        "--by",
        choices=("simulate", "sweep", "find_cycle"),
        help="who is asked to graze, or for derivatives (simulate)",
    )
    parser.add_argument(
        "--structure", type=_whole(0, STRUCTURES), help="of runs only this one of laws and edges"
    )
    parser.add_argument(
        "--tol", type=_positive, help="rtol and atol of runs; default: the package's"
    )
    parser.add_argument("--threads", type=_whole(1), help="threads of the engine (all)")
    parser.add_argument("--table", type=Path, help="page to put the rows of runs in")
    return parser


def put_rows(path, rows):
    """Puts rows before the mark in the page, in place of rows of the same campaign."""

    def key(row):
        cells = row.split(" | ")
        return (cells[0], cells[1], cells[3]) if len(cells) == 7 else row

    rows = [row for row in rows if row.startswith("| ")]
    new = {key(row) for row in rows}
    lines = [x for x in path.read_text(encoding="utf-8").splitlines() if key(x) not in new]
    place = lines.index("<!-- campaigns -->")
    path.write_text("\n".join([*lines[:place], *rows, *lines[place:], ""]), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
