"""One script for an accelerator: `python -m tests.benchmarks.device`, four minutes at most.

It proves and measures, part by part:

- proof: 300 runs against answers of the engine (`tests/campaign/engine.py`) that are stored beside
  this file: final states, and their derivatives by a velocity;
- w1: workload W1 of `test_sweep.py`, final states of class (b) at T = 100, tolerance 1e-8; by
  `jb.sweep`, and by its kernel alone, beside the bound of what the device can do;
- grad: `jax.vmap(jax.grad(..))` of final states, some of which are among the stored answers;
- regions, basins: labels of maps, some of which are stored.

`--parts` chooses among them and `--w1`, `--grad`, `--regions`, `--basins` tell how much is done, so
that a CPU does it, too. A part whose time is up stops where it is, and tells how far it came; one
that does not begin in time is left out. After each part the results are written, by the name of the
device, into a JSON file beside those of other devices; all are printed as a table. The exit code is
1 where an answer is wrong or a part failed.

`python -m tests.benchmarks.device --make-answers` makes the stored answers, on a CPU, with the
engine, which needs numba.
"""

import argparse
import contextlib
import functools
import json
import math
import os
import platform
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxbelt as jb
from jaxbelt.numerics import compiling, widths
from jaxbelt.sweeps import threads
from jaxbelt.sweeps.question import Question
from jaxbelt.sweeps.queue import ROUNDS_PER_PASS, STEPS_PER_ROUND, Common, _work

HERE = Path(__file__).parent
ANSWERS, RESULTS = HERE / "device_answers.json", HERE / "device.json"
PARTS = ("proof", "w1", "grad", "regions", "basins")
#: The time of the proof's runs, and of those that are differentiated.
PROVED = 40.0
#: Starts on the axis x1 = (these, 0), and velocities; round ones are avoided.
PROOF_AXES = {
    "b": {
        "nu0": np.linspace(-0.613, 0.587, 10),
        "nu1": np.linspace(-0.529, 0.571, 5),
        "x1": np.array([-2.037, 0.713, 2.519]),
    },
    "d": {
        "nu0": np.linspace(-0.487, 0.613, 10),
        "nu1": np.linspace(-0.571, 0.529, 5),
        "x1": np.array([-2.037, 0.713, 2.519]),
    },
}
#: Edges of class (d).
EDGES = (-0.31, 0.52)
#: Cells, or starts, along each side of the maps whose labels are stored, and of a tile.
STORED, TILE = 10, 1024
#: Lanes in one call of the gradients: 2 GB for every 2**14.
LANES = 2**16


def class_d(nu0, nu1):
    """Class (d) between two edges."""
    return jb.presets.class_d(nu0, nu1, *EDGES)


MAKE = {"b": jb.presets.class_b, "d": class_d}
OSCILLATOR = (0.45, 0.35)


# --- time and results -----------------------------------------------------------------------------


class Clock:
    """The seconds that the whole may take."""

    def __init__(self, seconds: float):
        self.end = time.monotonic() + seconds

    @property
    def left(self) -> float:
        return self.end - time.monotonic()

    def share(self, part: float) -> "Clock":
        """A clock for a part of what is left."""
        return Clock(part * self.left)


class Timed:
    """Seconds by the clock, and of the processor, while it is entered."""

    def __enter__(self):
        self.began = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_):
        self.seconds = time.perf_counter() - self.began[0]
        self.processor = time.process_time() - self.began[1]

    def rates(self, name: str, count: float) -> dict[str, float]:
        """How many a second."""
        return {
            f"{name}/s": count / self.seconds,
            f"{name}/s of the host's processor": count / max(self.processor, 1e-9),
        }


def device_name(forced: bool) -> str:
    """The device's own name; of a CPU what is known of it."""
    device = jax.devices()[0]
    name = device.device_kind
    if device.platform == "cpu":
        name = f"{os.cpu_count()} cores of {platform.machine()}"
    name += f" x {jax.local_device_count()}" if jax.local_device_count() > 1 else ""
    return f"{name}, in the form for accelerators" if forced else name


class Results:
    """The results of this device in the file, which is written after each part."""

    def __init__(self, path: Path, device: str):
        self.path, self.device = path, device
        self.all = json.loads(path.read_text()) if path.exists() else {}
        self.own: dict[str, Any] = self.all.setdefault(device, {})
        self.own["versions"] = {"jaxbelt": jb.__version__, "jax": jax.__version__}

    def put(self, part: str, found: dict[str, Any]) -> None:
        self.own[part] = found
        text = json.dumps(self.all, indent=1, sort_keys=True)
        beside = self.path.with_suffix(".part")
        beside.write_text(text + "\n")
        beside.replace(self.path)

    def table(self) -> str:
        """All devices side by side, a row for each number."""
        rows = []
        for part in PARTS:
            names: dict[str, None] = {}
            for found in self.all.values():
                names |= dict.fromkeys(found.get(part, {}))
            for name in names:
                told = [found.get(part, {}).get(name, "") for found in self.all.values()]
                rows.append([part, name, *map(in_words, told)])
        rows.insert(0, ["part", "", *self.all])
        wide = [max(map(len, column)) for column in zip(*rows)]
        return "\n".join("  ".join(w.ljust(n) for w, n in zip(row, wide)).rstrip() for row in rows)


def in_words(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


# --- proof ----------------------------------------------------------------------------------------


def proved(name: str) -> dict[str, np.ndarray]:
    """The proof's runs of a class, all values of its axes with all, [runs]."""
    axes = PROOF_AXES[name]
    options = dict(rtol=1e-11, atol=1e-11, t1=PROVED, derivatives=("nu0",), progress=False)
    found = jb.sweep(MAKE[name], axes, **options)
    names = ("x1_end", "x2_end", "d_x1_end_d_nu0", "d_x2_end_d_nu0", "n_events")
    return {variable: found[variable].values.ravel() for variable in names}


def proof(sizes, clock: Clock) -> dict[str, Any]:
    """The largest differences from the engine's answers."""
    answers, told = json.loads(ANSWERS.read_text()), {}
    right, runs = True, 0
    for name in sizes.classes:
        found, known = proved(name), {k: np.array(v) for k, v in answers[name].items()}
        runs += len(known["x1_end"])
        for variable, tol in (("x1_end", 1e-8), ("x2_end", 1e-8)):
            told[f"{name}: off by, {variable}"] = off = largest(found[variable], known[variable])
            right &= off < tol
        for variable in ("d_x1_end_d_nu0", "d_x2_end_d_nu0"):
            told[f"{name}: off by, {variable}"] = off = largest(found[variable], known[variable])
            right &= off < 1e-6
        right &= bool(np.array_equal(found["n_events"], known["n_events"]))
    return {"right": bool(right), "runs": runs, **told}


def largest(found, known) -> float:
    """The largest difference, relative where the numbers are above one."""
    off = np.abs(found - known) / np.maximum(1.0, np.abs(known))
    return float(np.max(np.where(np.isfinite(found), off, np.inf)))


def make_answers() -> None:
    """The engine's answers of the proof, and the package's labels of coarse maps, on a CPU."""
    # On a device there need be no numba.
    from tests.campaign import derivatives, engine
    from tests.campaign.cases import PAPER, Case

    answers: dict[str, Any] = {}
    for name, axes in PROOF_AXES.items():
        rows = []
        inner = EDGES if name == "d" else (-math.inf, math.inf)
        for nu0, nu1, x1 in np.stack(np.meshgrid(*axes.values(), indexing="ij"), -1).reshape(-1, 3):
            # Belt 0 touches below the upper edge, and belt 1 above the lower one.
            belts = (
                engine.Belt(float(nu0), PAPER, upper=inner[1]),
                engine.Belt(float(nu1), PAPER, lower=inner[0]),
            )
            case = Case(engine.Oscillator(0.5, belts), (float(x1), 0.0), PROVED)
            run = engine.simulate(case.oscillator, case.y0, PROVED)
            along = (0.0, 0.0), 0.0, ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
            slope = derivatives.derivative(case, run, along)
            rows.append((*run.y_end, *slope, len(run.kind), run.status))
        columns = np.array(rows).T
        assert not np.any(columns[5]), "a run did not end in time"
        names = ("x1_end", "x2_end", "d_x1_end_d_nu0", "d_x2_end_d_nu0", "n_events")
        answers[name] = {k: column.tolist() for k, column in zip(names, columns)}
    answers["regions"] = regions_of(*map_axes(STORED, REGIONS)).tolist()
    answers["basins"] = basins_of(*map_axes(STORED, BASINS)).tolist()
    ANSWERS.write_text(json.dumps(answers) + "\n")


# --- W1 -------------------------------------------------------------------------------------------


def w1_axes(runs: int) -> dict[str, np.ndarray]:
    """The velocities of W1, as many of each."""
    n = max(1, round(math.sqrt(runs)))
    steps = 1.4 * (np.arange(n) + 0.5) / n
    return {"nu0": steps - 0.7, "nu1": steps - 0.6987}


def w1(sizes, clock: Clock) -> dict[str, Any]:
    """Runs and events a second, by the sweep and by its kernel alone; the share of the bound."""
    options = dict(y0=(1.5, 0.0), t1=100.0, progress=False)
    done: dict[str, Any] = {}
    # At first few, for the program: as many as need the most lanes.
    for runs in sorted({min(sizes.w1, 40_000), sizes.w1}):
        axes = w1_axes(runs)
        count = len(axes["nu0"]) ** 2
        if done and clock.left < 2.5 * done["seconds"] * count / done["runs"]:
            done["not done"] = sizes.w1
            break
        jb.sweep(jb.presets.class_b, axes, **options) if not done else None
        with Timed() as timed:
            found = jb.sweep(jb.presets.class_b, axes, **options)
        events = int(found.n_events.sum())
        ok = float(np.mean((found.status.values == 0) | (found.status.values == 1)))
        done = {
            "runs": count,
            "seconds": timed.seconds,
            "events a run": events / count,
            "right": ok == 1.0 and bool(np.all(np.isfinite(found.x1_end.values))),
            "mean of |x1|": float(np.abs(found.x1_end).mean()),
            **timed.rates("runs", count),
            "returns/s": events / timed.seconds,
        }
        del found
        done |= kernel_alone(axes, options, events / count)
    return done


def kernel_alone(axes, options, events: float) -> dict[str, Any]:
    """The same runs by the kernel, whose results are not kept; and the bound of its passes."""
    asked = Question.of(
        jb.presets.class_b, axes, options["y0"], options["t1"], 1e-8, None, "final", ()
    )
    grid = asked.grid
    table, told, lane_passes, seconds = grid.rows(np.arange(grid.runs)), {}, 0, math.nan
    # Does a device gain where one thread makes queues while the lanes of another are at work?
    for each in (1, 2):
        counted = Counted()
        with counted.counting(), Timed() as timed:
            threads.run(
                asked.program,
                grid.shared,
                lambda first, last: table[..., first:last],
                grid.runs,
                lambda *_: None,
                threads=each * threads.workers(),
                **asked.numbers,
            )
        if each > 1:
            told[f"kernel: runs/s, {each} times the threads"] = grid.runs / timed.seconds
        else:
            lane_passes, seconds = counted.lane_passes, timed.seconds
    operations, moved = cost_of_pass(asked.program, grid.shared)
    rate, memory = peaks()
    bounds = {
        "float64 operations": lane_passes * operations / rate,
        # The few lanes of a CPU stay in its nearest cache.
        "memory": 0.0 if widths.is_cpu() else lane_passes * moved / memory,
    }
    bound = max(bounds, key=lambda name: bounds[name])
    return {
        "kernel: runs/s": grid.runs / seconds,
        "kernel: returns/s": events * grid.runs / seconds,
        **told,
        "kernel: steps of a lane a run": lane_passes
        * (ROUNDS_PER_PASS * STEPS_PER_ROUND / grid.runs),
        "float64 operations/s of the device": rate,
        "bytes/s of the device": memory,
        "kernel: bound by": bound,
        "kernel: share of the bound": bounds[bound] / seconds,
        "kernel: share of float64 operations": bounds["float64 operations"] / seconds,
    }


class Counted:
    """Passes of the kernel, times its lanes: what it has to do, idle lanes among it."""

    def __init__(self):
        self.lane_passes, self.lock = 0, threading.Lock()

    @contextlib.contextmanager
    def counting(self) -> Iterator[None]:
        own = threads.compiled

        def compiled(program) -> Callable:
            kernel = own(program)

            def call(common, queue, call, streams):
                out = kernel(common, queue, call, streams)
                passes = int(out[0][0].passes) - int(streams[0].passes)
                with self.lock:
                    self.lane_passes += passes * streams[0].ones.size
                return out

            return call

        threads.compiled = compiled  # pyright: ignore
        try:
            yield
        finally:
            threads.compiled = own


#: Primitives that are arithmetic of a lane: one operation each, whatever the device needs for it.
ARITHMETIC = frozenset(
    "add sub mul div sqrt abs neg max min sign exp log tanh pow integer_pow floor rem".split()
)


def cost_of_pass(program, shared) -> tuple[float, float]:
    """float64 operations of a lane in a pass, and bytes that it moves at least.

    Operations are counted in the traced program, each once, also where a device needs several for
    it, a division, say. Bytes: the state of a lane, read and written once in each step, which is
    what a loop over steps does whose body is one piece of machine code.
    """
    width = 256
    stream = threads._first_streams(program, shared, width, 2 + sum(program.mapped), 0)[0]
    common = Common(shared, *map(jnp.asarray, (100.0, 1e-8, np.nan, np.int32(1))))
    traced = jax.make_jaxpr(lambda stream: _work(program, common, stream, [])[0])(stream)
    state = sum(leaf.nbytes for leaf in jax.tree.leaves(stream.lanes)) / width
    return operations(traced.jaxpr) / width, 2 * state * ROUNDS_PER_PASS * STEPS_PER_ROUND


def operations(jaxpr) -> float:
    """float64 operations of a traced program; loops as often as they are passed."""
    total = 0.0
    for equation in jaxpr.eqns:
        if equation.primitive.name in ARITHMETIC:
            total += sum(v.aval.size for v in equation.outvars if v.aval.dtype == np.float64)
        times = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        for part in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "jaxpr")):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                total += times * operations(part)
    return total


@functools.cache
def peaks() -> tuple[float, float]:
    """float64 operations and bytes a second of all devices, by two small programs: multiplications
    and additions of numbers that stay in registers, and a copy of a large array."""
    small = jax.devices()[0].platform == "cpu"
    # Several chains beside each other: of one alone each operation waits for the one before.
    chains, length, rounds, size = 8, 32, 8, 2**16 if small else 2**21

    @functools.partial(jax.jit, compiler_options=compiling.known(compiling.WIDE))
    def multiply(x, a, b):
        def again(_, x):
            several = [x * (1.0 + i) for i in range(chains)]
            for _ in range(length):
                several = [one * a + b for one in several]
            return functools.reduce(jnp.add, several)

        return jax.lax.fori_loop(0, rounds, again, x)

    @jax.jit
    def copy(x, a):
        return x + a

    def fastest(call) -> float:
        jax.block_until_ready(call())
        found = []
        for _ in range(5):
            began = time.perf_counter()
            jax.block_until_ready(call())
            found.append(time.perf_counter() - began)
        return min(found)

    x, large = jnp.linspace(0.0, 1.0, size), jnp.zeros(2**22 if small else 2**27)
    devices = jax.local_device_count()
    rate = 2 * chains * (length + 1) * rounds * size / fastest(lambda: multiply(x, 0.5, 0.1))
    return devices * rate, devices * 2 * large.nbytes / fastest(lambda: copy(large, 1.0))


# --- gradients ------------------------------------------------------------------------------------


def grad(sizes, clock: Clock) -> dict[str, Any]:
    """Derivatives of x1 at the end by nu0, reverse mode, in a batch; the first are the proof's."""

    def end(nu0, nu1, x1):
        osc = jb.presets.class_b(nu0, nu1)
        run = jb.simulate(osc, (x1, 0.0), PROVED, ts=jnp.array([PROVED]))
        return run.ys[-1, 0]

    slopes = jax.jit(jax.vmap(jax.grad(end)))
    known = np.array(json.loads(ANSWERS.read_text())["b"]["d_x1_end_d_nu0"])
    stored = np.stack(np.meshgrid(*PROOF_AXES["b"].values(), indexing="ij"), -1).reshape(-1, 3)
    lanes, rng = min(LANES, sizes.grad), np.random.default_rng(0)
    rows = rng.uniform([-0.7, -0.7, -3.0], [0.7, 0.7, 3.0], (lanes, 3))
    rows[: len(stored)] = stored[:lanes]
    found = np.asarray(slopes(*rows.T))
    seen = min(len(known), lanes)
    off = largest(found[:seen], known[:seen])
    calls, done = -(-sizes.grad // lanes), 0
    with Timed() as timed:
        # The calls differ, lest one were made once for all.
        while done < calls and (not done or clock.left > 1.2 * elapsed(timed) / done):
            jax.block_until_ready(slopes(*(rows + 1e-3 * done).T))
            done += 1
    told = {"not done": sizes.grad} if done < calls else {}
    return {
        "right": bool(off < 1e-6),
        "off by": off,
        "gradients": done * lanes,
        "seconds": timed.seconds,
        "are numbers": float(np.mean(np.isfinite(found))),
        **timed.rates("gradients", done * lanes),
        **told,
    }


def elapsed(timed: Timed) -> float:
    return time.perf_counter() - timed.began[0]


# --- maps -----------------------------------------------------------------------------------------

#: Corners of the maps: of two velocities, and of starts.
REGIONS = ((-0.6987, 0.7), (-0.6961, 0.7013))
BASINS = ((-3.01, 3.0), (-2.0, 2.01))


def map_axes(n: int, corners) -> list[np.ndarray]:
    return [np.linspace(*span, n) for span in corners]


def regions_of(nu0, nu1) -> np.ndarray:
    return jb.region_map(jb.presets.class_b, {"nu0": nu0, "nu1": nu1}, lines=0).label


def basins_of(x1, x2) -> np.ndarray:
    return jb.basins(jb.presets.class_b(*OSCILLATOR), x1=x1, x2=x2).label.values


def mapped(part: str, call: Callable, corners, n: int, clock: Clock) -> dict[str, Any]:
    """A map of n x n labels, tile by tile, and whether those that are stored come out again."""
    known = np.array(json.loads(ANSWERS.read_text())[part])
    agree = float(np.mean(call(*map_axes(STORED, corners)) == known))
    told: dict[str, Any] = {"right": agree == 1.0, "as stored": agree}
    first, second = map_axes(n, corners)
    tiles = [
        (first[i : i + TILE], second[j : j + TILE])
        for i in range(0, n, TILE)
        for j in range(0, n, TILE)
    ]
    call(*tiles[0])  # compiles
    done = cells = 0
    with Timed() as timed:
        while done < len(tiles) and (not done or clock.left > 1.2 * elapsed(timed) / done):
            cells += call(*tiles[done]).size
            done += 1
    told |= {"cells": cells, "seconds": timed.seconds, **timed.rates("cells", cells)}
    return told | ({"not done": n * n} if done < len(tiles) else {})


def regions(sizes, clock: Clock) -> dict[str, Any]:
    """Labels of `region_map`, without the curves, which the host follows one by one."""
    return mapped("regions", regions_of, REGIONS, sizes.regions, clock)


def basins(sizes, clock: Clock) -> dict[str, Any]:
    """Labels of `basins`."""
    return mapped("basins", basins_of, BASINS, sizes.basins, clock)


# --- the script -----------------------------------------------------------------------------------

#: The part of the time left that a part may take.
SHARES = {"proof": 1.0, "w1": 0.5, "grad": 0.5, "regions": 0.6, "basins": 1.0}


def options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=_Raw)
    parser.add_argument("--seconds", type=float, default=240.0, help="after which it ends, 240")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--classes", nargs="+", choices=tuple(MAKE), default=tuple(MAKE))
    parser.add_argument("--w1", type=int, default=10**7, help="runs")
    parser.add_argument("--grad", type=int, default=10**6, help="derivatives")
    parser.add_argument("--regions", type=int, default=4096, help="cells along a side")
    parser.add_argument("--basins", type=int, default=4096, help="starts along a side")
    parser.add_argument("--file", type=Path, default=RESULTS)
    parser.add_argument("--as-on-accelerator", action="store_true", help="its form, on a CPU")
    parser.add_argument("--make-answers", action="store_true")
    return parser.parse_args(arguments)


class _Raw(argparse.RawDescriptionHelpFormatter):
    pass


def cut(results: Results, seconds: float) -> None:
    """End the process: no part may take more than there is, whatever it is at."""
    print(f"cut after {seconds:g} s; what was done is in {results.path}", flush=True)
    os._exit(2)


def main(arguments: list[str] | None = None) -> int:
    jax.config.update("jax_enable_x64", True)
    sizes = options(arguments)
    if sizes.make_answers:
        make_answers()
        return 0
    clock = Clock(sizes.seconds)
    results = Results(sizes.file, device_name(sizes.as_on_accelerator))
    timer = threading.Timer(sizes.seconds, cut, (results, sizes.seconds))
    timer.daemon = True
    timer.start()
    form = widths.as_on_accelerator if sizes.as_on_accelerator else contextlib.nullcontext
    right = True
    for part in sizes.parts:
        if clock.left < 0.1 * sizes.seconds:
            print(f"{part}: left out, {clock.left:.0f} s are left", flush=True)
            continue
        try:
            with form(), Timed() as timed:
                found = globals()[part](sizes, clock.share(SHARES[part]))
        except Exception as error:  # the other parts may work
            found = {"right": False, "failed": f"{type(error).__name__}: {error}"[:300]}
        else:
            found["seconds in all"] = timed.seconds
        right &= found["right"]
        results.put(part, found)
        print(part, json.dumps(found), flush=True)
    timer.cancel()
    print(results.table())
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
