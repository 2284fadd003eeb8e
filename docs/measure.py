"""Measures what each way to an answer costs, for the page "Which function for which question".

`python docs/measure.py` prints the table and writes it to docs/costs.md. Run it on a quiet machine;
it takes some minutes, most of them compilation, which begins with an empty cache. With names of
functions as arguments only these are measured, and nothing is written.
"""

import functools
import os
import platform
import re
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

# Programs that other sessions cached would hide the cost of a first call; programs of this session
# are cached, as for a user.
os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
KEPT = tempfile.TemporaryDirectory()
os.environ |= {"JAXBELT_CACHE": "1", "JAXBELT_CACHE_DIR": KEPT.name}

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxbelt as jb

OSC = jb.presets.class_b(nu0=0.45, nu1=0.35)
FAMILY = jb.presets.class_b
T = 100.0


def nu0(osc):
    """The velocity of belt 0."""
    return osc.belts[0].velocity


def nu1(osc):
    """The velocity of belt 1."""
    return osc.belts[1].velocity


class Question(NamedTuple):
    """A question, the call that answers it, and the number and the unit of its answers."""

    name: str
    asked: str
    call: Callable[[], Any]
    answers: int
    unit: str


def _end(velocity):
    return jb.simulate(FAMILY(velocity, 0.35), (3.0, 0.0), T).ys[-1]


def _square(n: int):
    nus = np.linspace(-0.7, 0.7, n)
    return {"nu0": nus, "nu1": nus}


def _record():
    ts = np.linspace(0.0, 60.0, 600)
    clean = np.asarray(jb.simulate(OSC, (1.5, 0.0), 60.0, ts=ts).ys[:, 0])
    return ts, clean + np.random.default_rng(0).normal(0.0, 0.01, ts.size)


def _fit():
    ts, x1 = _record()
    guess = FAMILY(0.5, 0.3)
    return jb.fit(guess, ts, x1, where=lambda o: (nu0(o), nu1(o)), noise=0.01, report=None)


def _amplitude(velocity):
    return jb.amplitude(jb.find_cycle(FAMILY(velocity, 0.35), (3.0, 0.0)))


FORCED = jb.presets.di_bernardo
FROM = (0.5, 0.0)


def frequency(osc):
    """The frequency of the force."""
    return osc.forcing[0].frequency


@functools.cache
def _sticking():
    """A forced motion that sticks and repeats after two periods."""
    return jb.find_cycle(FORCED(1.68), FROM)


@functools.cache
def _doubling():
    """A period doubling of the forced oscillator."""
    return jb.refine(jb.PeriodDoubling(), FORCED, at=1.71)


BATCH = jnp.linspace(0.3, 0.6, 1024)
STARTS = np.linspace(-3.0, 3.0, 256)
FINALS = jax.jit(jax.vmap(_end))
AMPLITUDES = jax.jit(jax.vmap(_amplitude))
SLOPES = jax.jit(jax.vmap(jax.grad(_amplitude)))
FOLDS = jax.jit(
    jax.vmap(
        lambda nu: (
            jb.refine(jb.NonsmoothFold(1), FAMILY(0.52 - 2.4 * (nu - 0.35), nu), where=nu0).value
        )
    )
)


def _point():
    return jb.refine(jb.NonsmoothFold(1), FAMILY(0.53, 0.35), where=nu0)


QUESTIONS = [
    Question(
        "simulate",
        f"one motion over {T:g} units of time, all samples and events",
        lambda: jb.simulate(OSC, (3.0, 0.0), T),
        1,
        "run",
    ),
    Question(
        "jax.jacfwd of simulate",
        "its final state's derivative by one parameter",
        lambda: jax.jacfwd(_end)(0.45),
        1,
        "run",
    ),
    Question(
        "jax.vmap of simulate",
        "1,024 motions as one differentiable function",
        lambda: FINALS(BATCH),
        1024,
        "run",
    ),
    Question(
        'sweep, observe="final"',
        "256 x 256 final states",
        lambda: jb.sweep(FAMILY, _square(256), t1=T, progress=False),
        256**2,
        "run",
    ),
    Question(
        'sweep, observe="attractor"',
        "256 x 256 attractors",
        lambda: jb.sweep(FAMILY, _square(256), observe="attractor", progress=False),
        256**2,
        "run",
    ),
    Question(
        "find_cycle",
        "the cycle that a start leads to",
        lambda: jb.find_cycle(OSC, (3.0, 0.0)),
        1,
        "cycle",
    ),
    Question(
        "jax.grad of find_cycle",
        "the derivative of its amplitude by one parameter",
        lambda: jax.grad(_amplitude)(0.45),
        1,
        "cycle",
    ),
    Question(
        "jax.vmap of find_cycle",
        "1,024 amplitudes",
        lambda: AMPLITUDES(BATCH),
        1024,
        "cycle",
    ),
    Question(
        "jax.vmap of jax.grad",
        "and their derivatives",
        lambda: SLOPES(BATCH),
        1024,
        "cycle",
    ),
    Question("unstable_cycle", "the unstable one", lambda: jb.unstable_cycle(OSC), 1, "cycle"),
    Question("portrait", "all there is at one oscillator", lambda: jb.portrait(OSC), 1, "portrait"),
    Question(
        "basins",
        "where each of 256 x 256 starts leads",
        lambda: jb.basins(OSC, x1=STARTS, x2=STARTS, progress=False),
        256**2,
        "start",
    ),
    Question("refine", "a bifurcation point near a guess", _point, 1, "point"),
    Question(
        "jax.vmap of refine",
        "256 points of a curve at given values",
        lambda: FOLDS(jnp.linspace(0.33, 0.37, 256)),
        256,
        "point",
    ),
    Question(
        "scan",
        "every point on a path, without a guess",
        lambda: jb.scan(OSC, nu0, (-0.7, 0.7)),
        1,
        "path",
    ),
    Question(
        "bifurcation_diagram",
        "the branches between them, too",
        lambda: jb.bifurcation_diagram(OSC, nu0, (-0.7, 0.7)),
        1,
        "path",
    ),
    Question(
        "orbit_diagram",
        "what a start leads to at 400 values",
        lambda: jb.orbit_diagram(OSC, nu0, (-0.7, 0.7)),
        400,
        "value",
    ),
    Question(
        "bifurcation_curve",
        "a point followed in two parameters",
        lambda: jb.bifurcation_curve(_point(), (nu0, nu1), ((-0.7, 0.7), (-0.7, 0.7))),
        1,
        "curve",
    ),
    Question(
        "region_map",
        "which motions there are over a plane of 64 x 64 cells, with exact bounds",
        lambda: jb.region_map(FAMILY, _square(64)),
        64**2,
        "cell",
    ),
    Question("fit", "two parameters from a noisy record of 600 data", _fit, 1, "fit"),
    Question(
        "design",
        "the parameter for which a cycle does what is wanted",
        lambda: jb.design(
            OSC, [(lambda c: jb.stick_duration(c, belt=1), 0.5)], where=nu0, report=None
        ),
        1,
        "design",
    ),
    Question(
        "periodic",
        "with forcing, the periodic motion near a guess",
        lambda: jb.periodic(FORCED(1.68), _sticking().start, periods=2),
        1,
        "motion",
    ),
    Question(
        "bifurcation_diagram, start=",
        "its branch, and the points on it",
        lambda: jb.bifurcation_diagram(FORCED(1.68), frequency, (1.675, 1.69), start=_sticking()),
        1,
        "branch",
    ),
    Question(
        "bifurcation_curve, forced",
        "a period doubling followed in two parameters",
        lambda: jb.bifurcation_curve(_doubling(), FORCED, ((1.6, 1.9), (0.02, 0.2))),
        1,
        "curve",
    ),
    Question(
        "lyapunov",
        "exponents of chaos over 1,000 periods",
        lambda: jb.lyapunov(FORCED(1.7), FROM),
        1,
        "run",
    ),
    Question(
        "circle_map",
        "where 400 slip onsets lead, and the periodic motions among them",
        lambda: jb.circle_map(FORCED(1.68)),
        1,
        "map",
    ),
    Question(
        'orbit_diagram, sense="both"',
        "points once in a period at 400 frequencies, rising and falling",
        lambda: jb.orbit_diagram(FORCED, span=(1.66, 1.73), y0=FROM, sense="both"),
        800,
        "value",
    ),
]


def seconds(call: Callable[[], Any]) -> float:
    """Seconds until a call has returned and its results are computed."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def words(span: float) -> str:
    """A time with two digits, in a unit that suits it, with a space that does not break lines."""
    units = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
    unit = next((unit for unit, size in units.items() if span >= size), "us")
    value = span / units[unit]
    digits = f"{value:.2g}" if value < 100 else f"{value:.0f}"
    return f"{digits}\N{NO-BREAK SPACE}{unit}"


def shown(name: str) -> str:
    """The name of a question with its functions as code."""
    return re.sub(r"[a-z.]+_?[a-z]*(?=,| of |$)|\bobserve=\S+", r"`\g<0>`", name)


def measured(question: Question) -> str:
    """Measures a question and returns its row of the table."""
    first = seconds(question.call)
    again = min(seconds(question.call) for _ in range(3 if first < 30 else 2))
    each = words(again / question.answers) if question.answers > 1 else ""
    return (
        f"| {shown(question.name)} | {question.asked} | {words(first)} | {words(again)} | {each} |"
    )


def main(names: list[str]) -> None:
    """Prints the table; writes it unless names choose a part."""
    lines = [
        "{.costs}",
        "| function | answer | first call | again | each |",
        "|---|---|---|---|---|",
    ]
    print("\n".join(lines), flush=True)
    for question in QUESTIONS:
        if not names or question.name in names:
            lines.append(measured(question))
            print(lines[-1], flush=True)
    if not names:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        note = f"Measured on {cores} cores of {platform.machine()}, with jaxbelt {jb.__version__}"
        note += f" and jax {jax.__version__}. The first call compiles what the rows above did not."
        page = "\n".join([*lines, "", note, ""])
        (Path(__file__).parent / "costs.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
