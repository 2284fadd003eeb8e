"""The paper's table of critical velocities and its figures, recomputed: `jaxbelt reproduce`.

`reproduce(folder)` finds the critical values, computes what the figures show, and draws them. The
phase portraits before, at and after a critical value are defined in one place, their entry in
`PORTRAITS`. All of them take the critical values from one tuple, that of `critical_values`.
"""

import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from .bifurcations.base import AbstractCondition
from .bifurcations.crossings import SlidingExchange
from .bifurcations.diagrams import BifurcationDiagram, bifurcation_diagram
from .bifurcations.regions import RegionMap, region_map
from .bifurcations.rests import Hopf, SuddenSliding
from .bifurcations.tangencies import GrazingSliding, NonsmoothFold
from .cycles.cycle import Cycle
from .cycles.unstable import from_starts
from .model.equilibria import Equilibria, equilibria
from .model.oscillator import Belt, Oscillator
from .model.variations import varied
from .motion.simulate import Trajectory, simulate
from .plotting.diagrams import plot_diagram
from .plotting.model import draw_mechanical_model, plot_convergence, plot_friction_law
from .plotting.phase import ClosedOrbit, plot_phase_portrait, plot_vector_field
from .plotting.regions import draw_region_map
from .plotting.style import Figure, draw_key, journal_figure, journal_style, save
from .presets import (
    PUBLISHED,
    PUBLISHED_NU1,
    class_a,
    class_b,
    class_c,
    class_d,
    paper_friction,
)
from .results import EventKind, Status

#: Duration of every portrait (dimensionless), and its number of samples.
TIME_SPAN, SAMPLES = 60.0, 2401
#: Room for the arcs of every run here, so that one program serves all.
SEGMENTS = 512
#: Transients that do not join a cycle are drawn until this time.
TRANSIENT = 25.0

MISPRINT = (
    "Class (a) is computed with p3 = 10. The 3.0 that the paper prints there is a misprint: it "
    "does not give the paper's values."
)
MISSING_REGION = (
    "Just below nu0 = 0 the exact cycle sticks on belt 0 only, Fig. 11 (c), until belt 1 joins in "
    "a grazing point at -0.0788: a region between 3a and 4c that the paper does not list."
)
#: Remarks beside the table.
REMARKS = (MISPRINT, MISSING_REGION)


# --- the table ----------------------------------------------------------------------------------


#: The condition that defines each critical value exactly.
CONDITIONS: dict[tuple[str, str], AbstractCondition] = {
    ("a", "nu_alpha"): NonsmoothFold(0),
    ("a", "nu_beta"): Hopf(),
    ("b", "nu_alpha"): NonsmoothFold(1),
    ("b", "nu_beta"): SlidingExchange((0, 1)),
    ("b", "nu_gamma"): Hopf(),
    ("b", "nu_delta"): SuddenSliding(0),
    ("b", "nu_epsilon"): Hopf(),
    ("b", "nu_zeta"): GrazingSliding(0),
    ("b", "nu_eta"): NonsmoothFold(1),
}
#: Distance of the guess for Newton's method from the printed value.
AWAY = 0.02


class CriticalValue(NamedTuple):
    """A critical velocity nu0 of the paper, recomputed.

    Attributes:
        system: Class of the oscillator.
        point: The paper's name of the point.
        kind: Its kind, in the paper's words.
        printed: The printed value.
        computed: Our value.
        residual: Residual of the defining equations there.
        iterations: Newton steps from a guess `AWAY` from the printed value.
        cycle: The cycle at the point, where there is one.
    """

    system: str
    point: str
    kind: str
    printed: float
    computed: float
    residual: float
    iterations: int
    cycle: Cycle | None


def critical_values() -> tuple[CriticalValue, ...]:
    """The table of section 3 of the paper, recomputed; NaN where Newton's method failed."""
    values = {}
    for system in ("a", "b"):
        rows = [published for published in PUBLISHED if published.system == system]
        osc = _with_two_belts(paper_oscillator(system, rows[0].printed))
        wanted = {row: CONDITIONS[system, row.point] for row in rows}
        velocity = varied(osc, _nu0, ())
        for row in rows:
            point = wanted[row].named_point_from(velocity, row.printed + AWAY)
            if point is None or point.condition != wanted[row]:
                values[row] = CriticalValue(*row, math.nan, math.nan, 0, None)
                continue
            values[row] = CriticalValue(
                *row,
                computed=float(point.value),
                residual=float(point.residual),
                iterations=int(point.iterations),
                cycle=point.cycle if isinstance(point.condition, NonsmoothFold) else None,
            )
    return tuple(values[row] for row in PUBLISHED)


def _nu0(osc: Oscillator) -> Any:
    return osc.belts[0].velocity


def table_as_json(values: Sequence[CriticalValue]) -> list[dict[str, Any]]:
    """The table as in critical_values.json."""
    return [
        {
            "class": value.system,
            "point": value.point,
            "kind": value.kind,
            "printed": value.printed,
            "computed": value.computed,
            "residual": value.residual,
            "iterations": value.iterations,
        }
        for value in values
    ]


def paper_oscillator(system: str, nu0: Any) -> Oscillator:
    """The paper's oscillator of class "a", or "b" with its nu1 = 0.35, at the velocity nu0."""
    return class_a(nu0) if system == "a" else class_b(nu0, PUBLISHED_NU1)


# --- phase portraits ----------------------------------------------------------------------------


class Panel(NamedTuple):
    """One phase portrait: its oscillator, starts of orbits, the cycle where it is known."""

    title: str
    oscillator: Oscillator
    starts: tuple[tuple[float, float], ...]
    cycle: Cycle | None


class Portraits(NamedTuple):
    """Phase portraits around one critical velocity: before, at, after (as nu0 falls).

    starts: relative to the fixed point, or to the middle of the segment of pseudo-equilibria.
    """

    system: str
    point: str
    before: float
    after: tuple[float, ...]
    xlim: tuple[float, float]
    ylim: tuple[float, float]
    starts: tuple[tuple[float, float], ...]
    note: str = ""

    def panels(self, values: Sequence[CriticalValue]) -> list[Panel]:
        """The panels a, b, c in order."""
        (critical,) = (v for v in values if (v.system, v.point) == (self.system, self.point))
        symbol = rf"\nu_0^\{self.point.removeprefix('nu_')}"
        relations = [
            (self.before, rf"\nu_0 = {self.before:.2f} > {symbol}", None),
            (critical.computed, rf"\nu_0 = {symbol} = {_shown(critical.computed)}", critical.cycle),
            *((nu0, rf"\nu_0 = {nu0:.2f} < {symbol}", None) for nu0 in self.after),
        ]
        panels = []
        for letter, (nu0, relation, cycle) in zip("abcd", relations, strict=False):
            osc = paper_oscillator(self.system, nu0)
            centre = float(equilibria(_with_two_belts(osc)).x1[0])
            starts = tuple((centre + x1, x2) for x1, x2 in self.starts)
            panels.append(Panel(f"({letter}) ${relation}$", osc, starts, cycle))
        return panels


def _shown(value: float) -> str:
    """A value with five digits; round ones, such as 0.35, without zeros."""
    return f"{value:g}" if abs(value - round(value, 2)) < 1e-9 else f"{value:.5f}"


class SimulatedCycle(NamedTuple):
    """The steady cycle in which a trajectory ends: its states in one loop."""

    states: np.ndarray
    stable: bool = True

    def sample(self, n: int) -> np.ndarray:
        return self.states


def simulate_panels(panels: Sequence[Panel]) -> list[list[Trajectory]]:
    """The orbits of every panel, sampled at the same times."""
    return [
        [_orbit(_with_two_belts(panel.oscillator), start) for start in panel.starts]
        for panel in panels
    ]


def _orbit(osc: Oscillator, start: tuple[float, float]) -> Trajectory:
    times = np.linspace(0.0, TIME_SPAN, SAMPLES)
    run = simulate(osc, start, TIME_SPAN, ts=times, rtol=1e-7, atol=1e-7, max_segments=SEGMENTS)
    return jax.tree.map(np.asarray, run)


def _with_two_belts(osc: Oscillator) -> Oscillator:
    """Class (a) as the paper has it, a limit of two belts: belt 1 is out of reach."""
    if len(osc.belts) == 2:
        return osc
    beyond = Belt(0.0, paper_friction(), lower=1e6)
    return Oscillator(osc.damping, (*osc.belts, beyond), osc.omega)


def steady_cycle(trajectory: Trajectory) -> SimulatedCycle | None:
    """The sticking cycle that a trajectory reaches, or None.

    The state at slip onset is known in full, so the motion repeats once it comes back.
    """
    times, states = np.asarray(trajectory.events.t), np.asarray(trajectory.events.y)
    onsets = np.flatnonzero(trajectory.events.kind == EventKind.SLIP)
    same = _onsets_at(states[onsets[-1]], trajectory) if onsets.size else onsets
    if same.size < 2:
        return None
    ts, ys = np.append(trajectory.ts, times), np.vstack([trajectory.ys, states])
    inside = (ts >= times[same[-2]]) & (ts <= times[same[-1]])
    return SimulatedCycle(ys[inside][np.argsort(ts[inside], kind="stable")])


def _onsets_at(state: np.ndarray, trajectory: Trajectory) -> np.ndarray:
    """Numbers of the events that are slip onsets at this state."""
    there = np.all(np.isclose(trajectory.events.y, state, atol=1e-6), axis=1)
    return np.flatnonzero(there & (np.asarray(trajectory.events.kind) == EventKind.SLIP))


def _transient(trajectory: Trajectory, cycle: SimulatedCycle | None) -> Trajectory:
    """The trajectory until it joins the cycle, or until TRANSIENT if that is earlier."""
    end = TRANSIENT
    if cycle is not None:
        joined = np.asarray(trajectory.events.t)[_onsets_at(cycle.states[0], trajectory)]
        end = np.min(joined, initial=end)
    times = trajectory.ts, trajectory.events.t
    shown = tuple(np.where(t <= end, t, np.nan) for t in times)
    return eqx.tree_at(lambda run: (run.ts, run.events.t), trajectory, shown)


def find_unstable_cycles(panels: Sequence[Panel]) -> list[Cycle]:
    """The unstable cycle of every panel, with the status NO_UNSTABLE_CYCLE where there is none."""
    return [from_starts(_with_two_belts(panel.oscillator)) for panel in panels]


def draw_portraits(portraits: Portraits, panels: Sequence[Panel]) -> Figure:
    """The portraits side by side: transients thin, the steady cycle thick, equilibria."""
    orbits, unstable = simulate_panels(panels), find_unstable_cycles(panels)
    figure = journal_figure(7.2, 2.75 if len(panels) == 3 else 4.9)
    if len(panels) == 3:
        axes = figure.subplots(1, 3, sharey=True)
    else:
        axes = figure.subplots(2, 2, sharex=True, sharey=True)
    for ax, panel, trajectories, repelling in zip(axes.flat, panels, orbits, unstable, strict=True):
        steady = [cycle for cycle in map(steady_cycle, trajectories) if cycle is not None]
        cycle = steady[0] if steady else None
        exists = int(repelling.status) == Status.OK
        cycles: list[ClosedOrbit] = [repelling] if exists else []
        if panel.cycle is not None:
            cycles.append(panel.cycle)
        elif cycle is not None:
            cycles.append(cycle)
        plot_phase_portrait(
            panel.oscillator,
            [_transient(trajectory, cycle) for trajectory in trajectories],
            cycles=cycles,
            equilibria=_rests_of(panel.oscillator),
            xlim=portraits.xlim,
            ylim=portraits.ylim,
            ax=ax,
        )
        ax.set_title(panel.title, loc="left")
        ax.label_outer()
    draw_key(figure, note=_with_symbols(portraits.note))
    return figure


def _with_symbols(remark: str) -> str:
    """A remark with symbols in place of the words that a terminal shows."""
    return remark.replace("p3", "$p_3$").replace("nu0", r"$\nu_0$").replace(" -", " \N{MINUS SIGN}")


def _rests_of(osc: Oscillator) -> Equilibria:
    """Equilibria of a panel. A subcritical Hopf point repels, whatever sign rounding gives its
    rate."""
    found = equilibria(_with_two_belts(osc))
    attracts = np.asarray(found.stable) & ~(np.abs(np.asarray(found.rate)) < 1e-9)
    return eqx.tree_at(lambda rows: rows.stable, found, attracts)


# --- the other figures --------------------------------------------------------------------------


def draw_model() -> Figure:
    """Fig. 1: the double-belt oscillator and Conti's friction law, eq. (7)."""
    figure = journal_figure(7.2, 2.9)
    model, law = figure.subplots(1, 2, width_ratios=(1.5, 1))
    draw_mechanical_model(model)
    friction = paper_friction()
    plot_friction_law(friction, law)
    mus, p1 = float(friction.static), float(friction.residual)
    for level in (-p1, p1):
        law.axhline(level, color="0.6", linewidth=0.6, linestyle=":", zorder=0)
    law.set_yticks([-mus, -p1, 0, p1, mus], [r"$-\mu_s$", "$-p_1$", "$0$", "$p_1$", r"$\mu_s$"])
    model.set_title("(a)", loc="left")
    law.set_title("(b)", loc="left")
    return figure


def draw_classes() -> Figure:
    """Fig. 2: the discontinuity boundaries of the four classes, here with the vector field."""
    figure = journal_figure(7.2, 5.0)
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    nu0, nu1 = 0.3, 0.7
    classes = (
        (
            class_a(nu0),
            r"(a) belt 0 only: $\sigma_0, \sigma_1 \to +\infty$",
            {"$D_1$": (2.6, -1.2), "$D_2$": (2.6, 1.2)},
        ),
        (
            class_b(nu0, nu1),
            r"(b) both belts: $\sigma_0 \to -\infty,\ \sigma_1 \to +\infty$",
            {"$D_1$": (2.6, -1.2), "$D_2$": (2.6, 0.5), "$D_3$": (2.6, 1.2)},
        ),
        (
            class_c(nu0, nu1, 0.5),
            r"(c) sequential: $\sigma_0 = \sigma_1 = \sigma$",
            {"belt 0": (-0.75, -1.2), "belt 1": (1.75, -1.2)},
        ),
        (
            class_d(nu0, nu1, -0.5, 1.0),
            r"(d) overlapping: $\sigma_0 < \sigma_1$",
            {"belt 0": (-1.25, -1.2), "both": (0.25, -1.2), "belt 1": (2.0, -1.2)},
        ),
    )
    white = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
    for ax, (osc, title, names) in zip(axes.flat, classes, strict=True):
        plot_vector_field(osc, xlim=(-2.0, 3.0), ylim=(-1.5, 1.5), ax=ax)
        for name, (x1, x2) in names.items():
            ax.text(x1, x2, name, ha="center", va="center", bbox=white)
        ax.set_title(title, loc="left")
        ax.label_outer()
    return figure


def formulation_errors(
    formulation: str, width: str, widths: np.ndarray
) -> tuple[np.ndarray, float]:
    """Largest error of a formulation over [0, 15] for each width of its band, and its order.

    Class (b) with nu0 = -0.2, nu1 = 0.35 from (2, 0): four stick phases, both belts. The order is
    the slope over the three smallest widths.
    """
    osc, y0, span = class_b(-0.2, PUBLISHED_NU1), (2.0, 0.0), 15.0
    ts = np.linspace(0.0, span, SAMPLES)
    exact = simulate(osc, y0, span, ts=ts, max_segments=SEGMENTS).ys

    def error(value):
        run = simulate(osc, y0, span, ts=ts, formulation=formulation, **{width: value})
        return float(np.max(np.abs(np.asarray(run.ys) - np.asarray(exact))))

    errors = np.array([error(value) for value in widths])
    order = np.polyfit(np.log(widths[-3:]), np.log(errors[-3:]), 1)[0]
    return errors, float(order)


class Study(NamedTuple):
    """A formulation: its name and the symbol of its band, errors over widths, and their order."""

    formulation: str
    symbol: str
    errors: np.ndarray
    order: float


WIDTHS = np.logspace(-2, -5, 7)


def study_formulations() -> list[Study]:
    """Errors of the switch and the smooth formulation against the exact motion, over WIDTHS."""
    return [
        Study(formulation, symbol, *formulation_errors(formulation, width, WIDTHS))
        for formulation, width, symbol in (
            ("switch", "v_star", r"$v_\ast$"),
            ("smooth", "eps", r"$\varepsilon$"),
        )
    ]


def draw_formulations(studies: Sequence[Study]) -> Figure:
    """Draws the errors of both formulations over the width of their band."""
    figure = journal_figure(4.2, 3.2)
    curves = {
        f"{study.formulation}, {study.symbol}: order {study.order:.2f}": study.errors
        for study in studies
    }
    plot_convergence(WIDTHS, curves, figure.subplots())
    return figure


def diagram_a() -> BifurcationDiagram:
    """Diagram of Fig. 3: equilibria and cycles of the oscillator with one belt, over its
    velocity."""
    diagram = bifurcation_diagram(_with_two_belts(class_a(0.2)), _nu0, (0.0, 0.4))
    # With one belt only the paper gives these regions no letter.
    regions = tuple((first, last, name[:1]) for first, last, name in diagram.regions)
    return replace(diagram, regions=regions)


def diagram_b() -> BifurcationDiagram:
    """Diagram of Fig. 7: equilibria and cycles of class (b) over nu0, along nu1 = 0.35."""
    return bifurcation_diagram(class_b(0.3, PUBLISHED_NU1), _nu0, (-0.7, 0.7))


def map_b() -> RegionMap:
    """Map of Fig. 6: the plane of both velocities. No cell lies on the lines nu0 = nu1 and nu =
    0."""
    nu0, nu1 = np.linspace(-0.7, 0.7, 120), np.linspace(-0.7, 0.7, 118)
    return region_map(class_b, {"nu0": nu0, "nu1": nu1}, step=0.02, lines=4)


def draw_map(regions: RegionMap) -> Figure:
    """Fig. 6, with the regions that the paper does not list."""
    figure = journal_figure(7.2, 9.0)
    draw_region_map(regions, figure)
    return figure


def draw_diagram(diagram: BifurcationDiagram, note: str) -> Figure:
    """Fig. 3 or 7."""
    figure = journal_figure(7.2, 4.2)
    plot_diagram(diagram, figure.subplots(), quantity="x2")
    draw_key(figure, note=_with_symbols(note))
    return figure


#: The phase portraits of the paper, by file name.
PORTRAITS: dict[str, Portraits] = {
    "fig04": Portraits(
        "a",
        "nu_alpha",
        before=0.30,
        after=(0.23,),
        xlim=(0.0, 1.6),
        ylim=(-0.6, 0.5),
        starts=((0.5, 0.45), (-0.6, 0.0), (0.3, 0.0), (0.12, 0.0)),
        note=MISPRINT,
    ),
    "fig05": Portraits(
        "a",
        "nu_beta",
        before=0.21,
        after=(0.14,),
        xlim=(0.0, 1.6),
        ylim=(-0.6, 0.5),
        starts=((0.5, 0.45), (-0.6, 0.0), (0.24, 0.0), (0.1, 0.0)),
        note=MISPRINT,
    ),
    "fig08": Portraits(
        "b",
        "nu_alpha",
        before=0.60,
        after=(0.45,),
        xlim=(0.4, 2.3),
        ylim=(-0.7, 0.8),
        starts=((0.4, 0.75), (-0.8, 0.0), (0.45, 0.0), (0.15, 0.0)),
    ),
    "fig09": Portraits(
        "b",
        "nu_beta",
        before=0.40,
        after=(0.30,),
        xlim=(0.4, 2.3),
        ylim=(-0.7, 0.8),
        starts=((0.4, 0.75), (-0.8, 0.0), (0.4, 0.0), (0.12, 0.0)),
    ),
    "fig10": Portraits(
        "b",
        "nu_gamma",
        before=0.30,
        after=(0.20,),
        xlim=(0.4, 2.3),
        ylim=(-0.7, 0.8),
        starts=((0.4, 0.75), (-0.8, 0.0), (0.3, 0.0), (0.1, 0.0)),
    ),
    "fig11": Portraits(
        "b",
        "nu_delta",
        before=0.10,
        after=(-0.05, -0.15),
        xlim=(-1.0, 2.6),
        ylim=(-0.7, 0.7),
        starts=((0.6, 0.6), (-0.5, 0.6), (-0.4, -0.6), (0.1, 0.0)),
        note=MISSING_REGION,
    ),
    "fig12": Portraits(
        "b",
        "nu_zeta",
        before=-0.40,
        after=(-0.50,),
        xlim=(-1.0, 1.0),
        ylim=(-0.8, 0.8),
        starts=((0.4, 0.75), (-0.4, -0.75), (0.415, 0.0), (0.15, 0.0)),
    ),
    "fig13": Portraits(
        "b",
        "nu_eta",
        before=-0.52,
        after=(-0.60,),
        xlim=(-1.0, 1.0),
        ylim=(-0.8, 0.8),
        starts=((0.4, 0.75), (-0.4, -0.75), (0.3, 0.0), (0.15, 0.0)),
    ),
}


#: File names of all figures: those of the paper that can be drawn, and one of our own.
FIGURES = sorted([*PORTRAITS, "fig01", "fig02", "fig03", "fig06", "fig07", "formulations"])


def steps() -> int:
    """Number of progress reports of `reproduce`."""
    return len(FIGURES) + 2


def reproduce(
    folder: Path, progress: Callable[[str], None] = lambda done: None
) -> tuple[CriticalValue, ...]:
    """Write critical_values.json and every figure as PNG into the folder; returns the table.

    folder: made where it is not there. progress: called `steps()` times, with what comes next.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # From a cold start most of the time goes into compiling. Two threads use two cores: this one
    # computes the region map, which takes the longest; the other one does the rest, and all the
    # drawing. The diagrams come last, because the map compiles most of their programs before.
    with ThreadPoolExecutor(1) as beside:
        drawings: list[Future] = []

        def draw(name: str, figure: Callable[..., Figure], *given: Any) -> None:
            def drawn():
                progress(name)
                with journal_style():
                    save(figure(*given), folder / f"{name}.png")

            drawings.append(beside.submit(drawn))

        progress("critical values")
        draw("formulations", lambda: draw_formulations(study_formulations()))
        draw("fig01", draw_model)
        draw("fig02", draw_classes)
        values = critical_values()
        text = json.dumps(table_as_json(values), indent=2)
        (folder / "critical_values.json").write_text(text + "\n", encoding="utf-8")

        panels = {name: figure.panels(values) for name, figure in PORTRAITS.items()}
        for name, own in panels.items():
            draw(name, draw_portraits, PORTRAITS[name], own)
        draw("fig03", lambda: draw_diagram(diagram_a(), MISPRINT))
        draw("fig07", lambda: draw_diagram(diagram_b(), MISSING_REGION))
        progress("region map")
        draw("fig06", draw_map, map_b())
        for drawing in drawings:
            drawing.result()
    return values
