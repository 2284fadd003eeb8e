"""How long a call may leave somebody at a terminal, or at a notebook, without a sign of life.

`python -m tools.silence` calls each function that may take long twice in its own process, in which
nothing was compiled before the first call. Names choose functions, and `--notebook` runs them in a
kernel of Jupyter (the group `notebooks`) instead of a pseudo-terminal. Every change on the screen
gets a time stamp. The table shows the seconds that a call takes, and the longest time between two
changes, where the beginning and the end of the call count as changes.
"""

import argparse
import contextlib
import json
import os
import pty
import queue
import re
import select
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: Source of the calls, by the name of the function.
CALLS = {
    "simulate": "jb.simulate(osc, (3.0, 0.0), 100.0)",
    "find_cycle": "jb.find_cycle(osc, (3.0, 0.0))",
    "unstable_cycle": "jb.unstable_cycle(osc)",
    "equilibria": "jb.equilibria(osc)",
    "lyapunov_coefficient": "jb.lyapunov_coefficient(osc)",
    "refine": "jb.refine(jb.NonsmoothFold(1), osc, where=nu0)",
    "scan": "jb.scan(osc, nu0, (-0.7, 0.7))",
    "bifurcation_diagram": "jb.bifurcation_diagram(osc, nu0, (-0.7, 0.7))",
    "bifurcation_curve": "jb.bifurcation_curve(point, (nu0, nu1), ((-0.7, 0.7), (-0.7, 0.7)))",
    "region_map": "jb.region_map(jb.presets.class_b, square(32))",
    "fit": "jb.fit(osc, ts, x1, where=lambda o: (nu0(o), nu1(o)), noise=0.01)",
    "design": "jb.design(osc, [(jb.amplitude, 1.2)], where=nu0)",
    "portrait": "jb.portrait(osc)",
    "basins": "jb.basins(osc, x1=row, x2=row)",
    "sweep": "jb.sweep(jb.presets.class_b, square(1024), t1=100.0)",
    "orbit_diagram": "jb.orbit_diagram(osc, nu0, (-0.7, 0.7))",
    "minimal_fatal_shock": "jb.minimal_fatal_shock(osc, (3.0, 0.0))",
    "basin_fractions": "jb.basin_fractions(osc, nu0, (-0.7, 0.7), box=box, key=jax.random.key(0))",
    "basin_stability": "jb.basin_stability(osc, box=box, key=jax.random.key(0))",
    "finite_time_stability": "basins.finite_time_stability(10.0, within=0.1)",
    "energy_dissipated": "jb.energy_dissipated(cycle)",
    "sample": "cycle.sample(400)",
    "plot_phase_portrait": "jb.plot_phase_portrait(osc, cycles=[cycle])",
    "plot_vector_field": "jb.plot_vector_field(osc)",
    "attractors": "jb.attractors(dataset)",
    "in_si": "jb.in_si(cycle, machine)",
    "plot": "cycle.plot()",
    "explore": "jb.explore(osc)",
    "explain": "jb.explain(jb.presets.class_b, square(1024), t1=100.0)",
    "jax.jacfwd": "jax.block_until_ready(jax.jacfwd(end)(0.45))",
    "jax.vmap": "jax.block_until_ready(jax.vmap(end)(0.45 + 0.001 * np.arange(256)))",
}
BEFORE = """
import jax
import numpy as np
jax.config.update("jax_enable_x64", True)
import jaxbelt as jb
osc = jb.presets.class_b(nu0=0.45, nu1=0.35)
nu0, nu1 = (lambda o: o.belts[0].velocity), (lambda o: o.belts[1].velocity)
row, box = np.linspace(-3.0, 3.0, 200), ((-2.0, 2.0), (-1.0, 1.0))
square = lambda n: dict.fromkeys(("nu0", "nu1"), np.linspace(-0.7, 0.7, n))
end = lambda nu: jb.simulate(jb.presets.class_b(nu, 0.35), (3.0, 0.0), 30.0).ys[-1]
"""
#: Source of what a call needs, run before the call, by the name of the function.
NEEDED = {
    "finite_time_stability": "basins = jb.basins(osc, x1=row, x2=row)",
    **dict.fromkeys(
        ("energy_dissipated", "plot", "plot_phase_portrait", "sample"),
        "cycle = jb.find_cycle(osc, (3.0, 0.0))",
    ),
    "attractors": """
axes = {"nu0": np.linspace(-0.7, 0.7, 64), "x1": np.linspace(-2.0, 2.0, 64)}
dataset = jb.sweep(jb.presets.class_a, axes, observe="attractor")
""",
    "in_si": """
law = jb.Conti(1.0, 0.6, 10.0)
machine = jb.Machine(1.0, 1.0, 0.5, (jb.PhysicalBelt(0.45, law, 1.0),))
cycle = jb.find_cycle(machine.oscillator, (3.0, 0.0))
""",
    "bifurcation_curve": "point = jb.refine(jb.NonsmoothFold(1), osc, where=nu0)",
    "fit": """
ts = np.linspace(0.0, 60.0, 600)
x1 = np.asarray(jb.simulate(jb.presets.class_b(0.5, 0.3), (1.5, 0.0), 60.0, ts=ts).ys[:, 0])
x1 = x1 + np.random.default_rng(0).normal(0.0, 0.01, ts.size)
""",
}
CONTROL = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]|[\r\n]")


def longest(times: Iterable[float]) -> tuple[float, float]:
    """Longest interval between successive times, and its beginning, counted from the first time."""
    times = list(times)
    return max((after - before, before - times[0]) for before, after in pairwise(times))


def told(name: str, turn: str, times: list[float]) -> str:
    """A line of the table; times: of the call's beginning, each change on the screen, the end."""
    gap, at = longest(times)
    return f"{name:20} {turn:6} {times[-1] - times[0]:8.2f} {gap:8.2f} {at:8.2f} {len(times) - 2:8}"


# --- a terminal -----------------------------------------------------------------------------------

CHILD = """
import os, sys, time
mark = lambda: os.write({pipe}, f"{{time.monotonic()}}\\n".encode())
exec({before!r})
call = compile({call!r}, "call", "eval")
for _ in range(2):
    mark(); eval(call); mark()
    time.sleep(0.5)
"""


def on_terminal(name: str) -> list[str]:
    """Runs a call twice in one process at a pseudo-terminal; returns both lines of the table."""
    here, there = pty.openpty()
    told_by, pipe = os.pipe()
    program = CHILD.format(pipe=pipe, before=BEFORE + NEEDED.get(name, ""), call=CALLS[name])
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "100"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    child = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=ROOT,
        stdout=there,
        stderr=there,
        pass_fds=(pipe,),
        env=environment,
    )
    os.close(there)
    os.close(pipe)
    changes, shown = [], ""
    while True:
        select.select([here], [], [])
        try:
            text = os.read(here, 1 << 16).decode(errors="replace")
        except OSError:  # the other end is closed
            break
        plain = CONTROL.sub("", text).strip()
        if plain and plain != shown:
            changes.append(time.monotonic())
            shown = plain
    os.close(here)
    with os.fdopen(told_by) as marks:
        stamps = [float(line) for line in marks]
    if child.wait() or len(stamps) != 4:
        return [f"{name:20} failed: {shown[-300:]}"]
    return _lines(name, stamps, changes)


def _lines(name: str, stamps: list[float], changes: list[float]) -> list[str]:
    lines = []
    for turn, begin, end in (("first", *stamps[:2]), ("again", *stamps[2:])):
        lines.append(told(name, turn, [begin, *(t for t in changes if begin < t < end), end]))
    return lines


# --- a notebook -----------------------------------------------------------------------------------


def in_notebook(name: str) -> list[str]:
    """Runs a call twice in one kernel of Jupyter; returns both lines of the table."""
    from jupyter_client.manager import start_new_kernel

    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    manager, client = start_new_kernel(env=environment)
    arrived: queue.Queue = queue.Queue()

    ended = threading.Event()

    def listen() -> None:
        while not ended.is_set():
            with contextlib.suppress(queue.Empty):
                message = client.get_iopub_msg(timeout=0.5)
                arrived.put((time.monotonic(), message))

    listener = threading.Thread(target=listen)
    listener.start()
    try:
        stamps, changes = [], []
        for code in (BEFORE + NEEDED.get(name, ""), *[f"_ = {CALLS[name]}"] * 2):
            began, sent = time.monotonic(), client.execute(code)
            shown = ""
            while True:
                at, message = arrived.get()
                kind, content = message["msg_type"], message["content"]
                own = message["parent_header"].get("msg_id") == sent
                if kind == "error":
                    return [f"{name:20} failed: {content['evalue']}"]
                if own and kind == "status" and content["execution_state"] == "idle":
                    break
                is_output = kind in ("stream", "display_data", "update_display_data", "comm_msg")
                text = json.dumps(content.get("text") or content.get("data"), sort_keys=True)
                if is_output and text != shown:
                    changes.append(at)
                    shown = text
            stamps += [began, at]
        return _lines(name, stamps[2:], changes)
    finally:
        ended.set()
        listener.join()
        client.stop_channels()
        manager.shutdown_kernel(now=True)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(CALLS))
    parser.add_argument("--notebook", action="store_true", help="in a kernel of Jupyter")
    options = parser.parse_args()
    if unknown := set(options.names) - CALLS.keys():
        parser.error(f"there is no {', '.join(sorted(unknown))}")
    print(f"{'function':20} {'call':6} {'seconds':>8} {'silence':>8} {'from':>8} {'changes':>8}")
    for name in options.names or CALLS:
        lines = in_notebook(name) if options.notebook else on_terminal(name)
        print("\n".join(lines), flush=True)


if __name__ == "__main__":
    main()
