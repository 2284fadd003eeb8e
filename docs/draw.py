"""Draws the pictures of the documentation into docs/pictures: `python docs/draw.py [NAME ...]`.

Pictures are stored, because drawing takes minutes. The gallery has one function for each picture,
whose code the page shows beside it; each kind of bifurcation is drawn in the same way.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import matplotlib
import numpy as np
from matplotlib.figure import Figure

jax.config.update("jax_enable_x64", True)
matplotlib.use("Agg")

import jaxbelt as jb
from jaxbelt import paper
from jaxbelt.bifurcations.conditions import AbstractCondition
from jaxbelt.plotting.model import draw_mechanical_model
from jaxbelt.plotting.phase import draw_orbit, plot_portrait
from jaxbelt.plotting.style import draw_key, journal_figure, journal_style

PICTURES = Path(__file__).parent / "pictures"

# --- gallery --------------------------------------------------------------------------------------


def nu0(osc):
    """The velocity of belt 0."""
    return osc.belts[0].velocity


def model():
    """The oscillator: mass, spring, dashpot and two belts."""
    figure = journal_figure(5.2, 4.2)
    figure.get_layout_engine().set(w_pad=0, h_pad=0)
    draw_mechanical_model(figure.subplots())
    return figure


def region_map():
    """The plane of both belt velocities: which motions there are, and what bounds them."""
    return paper.draw_map(paper.map_b())


def history():
    """One run: displacement and velocity over time, stick phases shaded."""
    osc = jb.presets.class_b(nu0=-0.2, nu1=0.35)
    run = jb.simulate(osc, y0=(2.0, 0.0), t1=40.0)
    figure = journal_figure(5.2, 3.4)
    jb.plot_time_history(run, figure.subplots(2, sharex=True))
    return figure


def phase_plane():
    """A run in the phase plane, and the stick-slip cycle that it settles on."""
    osc = jb.presets.class_b(nu0=-0.2, nu1=0.35)
    run = jb.simulate(osc, y0=(2.0, 0.0), t1=40.0)
    cycle = jb.find_cycle(osc, y0=(2.0, 0.0))
    return jb.plot_phase_portrait(osc, run, cycles=[cycle]).figure


def diagram():
    """Equilibria and cycles along a path, with every bifurcation point on it."""
    osc = jb.presets.class_b(nu0=0.3, nu1=0.35)
    figure = journal_figure(6.6, 4.0)
    jb.bifurcation_diagram(osc, nu0, (-0.7, 0.7), rows=480).plot(figure.subplots())
    return figure


def orbit_diagram():
    """What two starts lead to, and a part of it computed anew."""
    osc = jb.presets.class_b(nu0=0.45, nu1=0.35)
    starts, part = [(3.0, 0.0), (1.36, 0.0)], (-0.6, -0.42)
    whole = jb.orbit_diagram(osc, nu0, (-0.7, 0.7), y0=starts)
    figure = journal_figure(6.6, 3.2)
    left, right = figure.subplots(1, 2)
    whole.plot(left).axvspan(*part, color="0.9")
    whole.over(part).plot(right)
    return figure


def basins():
    """Which start leads where, and the unstable cycle between the basins."""
    osc = jb.presets.class_b(nu0=0.45, nu1=0.35)
    found = jb.basins(osc, x1=np.linspace(-1, 4, 251), x2=np.linspace(-1.5, 1.5, 151))
    figure = journal_figure(5.2, 3.6)
    jb.plot_basins(found, ax=figure.subplots())
    return figure


def basin_fractions():
    """How much of a box of starts each attractor attracts, along a parameter."""
    osc = jb.presets.class_b(nu0=0.45, nu1=0.35)
    box, key = ((-0.5, 2.0), (-0.4, 0.4)), jax.random.key(0)
    figure = journal_figure(5.2, 3.2)
    found = jb.basin_fractions(osc, nu0, (-0.7, 0.7), box=box, key=key, n=4000, rows=140)
    found.plot(figure.subplots())
    return figure


def portrait():
    """Everything there is at one oscillator, separatrices included."""
    osc = jb.presets.class_c(nu0=-0.3, nu1=0.3, sigma=0.1)
    figure = journal_figure(5.2, 3.8)
    jb.portrait(osc).plot(figure.subplots())
    return figure


def curve():
    """A bifurcation followed in two parameters, through points of codimension two."""
    osc = jb.presets.class_b(nu0=-0.45, nu1=0.35)
    point = jb.refine(jb.GrazingSliding(belt=0), osc, where=nu0)
    plane = (nu0, lambda o: o.belts[1].velocity)
    figure = journal_figure(5.2, 3.6)
    jb.bifurcation_curve(point, plane, ((-0.7, 0.7), (-0.7, 0.7))).plot(figure.subplots())
    return figure


def vector_field():
    """The vector field of two belts that overlap; it jumps at the boundaries."""
    osc = jb.presets.class_d(nu0=0.3, nu1=0.7, sigma0=-0.5, sigma1=1.0)
    figure = journal_figure(5.2, 3.4)
    jb.plot_vector_field(osc, xlim=(-2.0, 3.0), ylim=(-1.5, 1.5), ax=figure.subplots())
    return figure


def friction_laws():
    """Three friction laws."""
    laws = [
        jb.Conti(static=1.0, residual=0.6, steepness=10.0),
        jb.Stribeck(static=1.0, kinetic=0.6, velocity=0.2),
        jb.Coulomb(static=1.0, kinetic=0.6),
    ]
    figure = journal_figure(6.6, 2.4)
    for law, ax in zip(laws, figure.subplots(1, 3, sharey=True)):
        jb.plot_friction_law(law, ax=ax)
        ax.set_title(type(law).__name__)
        ax.label_outer()
    return figure


def period_map():
    """The period of what a start leads to, over a plane of two velocities."""
    nus = np.linspace(-0.7, 0.7, 200)
    axes = {"nu0": nus, "nu1": nus}
    found = jb.sweep(jb.presets.class_b, axes, observe="attractor", progress=False)
    figure = journal_figure(4.6, 3.6)
    found.period.plot(x="nu0", y="nu1", ax=figure.subplots(), cmap="cividis", vmax=20)
    return figure


def circle_map():
    """Sticking motions as orbits of a circle map, of a cubic law and of Conti's."""
    conti = jb.Belt(0.3, jb.Conti(static=1.0, residual=0.6, steepness=10.0))
    pushed = jb.Oscillator(0.1, (conti,), forcing=jb.Harmonic(amplitude=0.5, frequency=1.3))
    figure = journal_figure(6.6, 3.8)
    for ax, osc in zip(figure.subplots(1, 2), (jb.presets.di_bernardo(1.68), pushed)):
        jb.circle_map(osc).plot(ax)
    return figure


def forced_curves():
    """Curves of a forced oscillator that meet in a point where two conditions hold."""
    oscillator, span = jb.presets.di_bernardo, ((1.6, 1.9), (0.02, 0.2))
    figure = journal_figure(5.2, 3.6)
    ax = figure.subplots()
    conditions = {1.6676: jb.GrazingSliding(0), 1.7078: jb.GrazingSliding(0)}
    conditions |= {1.6834: jb.Fold(), 1.713: jb.PeriodDoubling()}
    for frequency, condition in conditions.items():
        point = jb.refine(condition, oscillator, at=frequency)
        jb.bifurcation_curve(point, oscillator, span).plot(ax)
    return figure


GALLERY = [model, region_map, history, phase_plane, diagram, orbit_diagram, basins]
GALLERY += [basin_fractions, portrait, curve, period_map, vector_field, friction_laws, circle_map]
GALLERY += [forced_curves]

# --- bifurcations ---------------------------------------------------------------------------------


class Case(NamedTuple):
    """A kind of bifurcation in one parameter: oscillators, a guess, and values on both sides."""

    condition: AbstractCondition
    make: Callable
    symbol: str
    guess: float
    before: float
    after: float
    parts: bool = False  # whether separatrices are drawn


class Lorentz(jb.AbstractFriction):
    """mu(r) = kinetic + (static - kinetic)/(1 + (r/width)^2), steepest away from r = 0."""

    static: float
    kinetic: float
    width: float

    def mu(self, speed):
        """Kinetic friction coefficient."""
        return self.kinetic + (self.static - self.kinetic) / (1 + (speed / self.width) ** 2)


def bell_shaped(nu):
    """One belt with a law that is steepest at some speed."""
    return jb.Oscillator(0.4, (jb.Belt(nu, Lorentz(1.0, 0.6, 0.4)),))


def weakly_held(load):
    """Two belts, of which belt 1 can hold little."""
    belts = [(-0.1, 0.4, 12.0, 1.1), (0.035, 0.3, 4.0, load)]
    return jb.Oscillator(
        0.45, [jb.Belt(nu, jb.Conti(1.0, p1, p3), load=load) for nu, p1, p3, load in belts]
    )


def overlapping(sigma1):
    """Belt 0 touches to the left of sigma1, belt 1 to the right of 0."""
    return jb.presets.class_d(0.35, 0.2, 0.0, sigma1)


def beside(sigma1, sigma0, damping, *nu):
    """Belt 0 touches up to sigma1, belt 1 from sigma0 on, so both or none touch in between."""
    law = jb.Conti(1.0, 0.6, 10.0)
    belts = (jb.Belt(nu[0], law, upper=sigma1), jb.Belt(nu[1], law, lower=sigma0))
    return jb.Oscillator(damping, belts)


def both(nu):
    """The paper's class (b) with nu1 = 0.35."""
    return jb.presets.class_b(nu, 0.35)


CASES = {
    "Hopf": Case(jb.Hopf(), jb.presets.class_a, r"\nu_0", 0.18, 0.2, 0.165),
    "NonsmoothFold": Case(jb.NonsmoothFold(0), jb.presets.class_a, r"\nu_0", 0.26, 0.25, 0.28),
    "GrazingSliding": Case(jb.GrazingSliding(0), both, r"\nu_0", -0.45, -0.40, -0.50),
    "CrossingSliding": Case(jb.CrossingSliding(1), weakly_held, "u_{01}", 0.3, 0.2, 0.4),
    "SlidingExchange": Case(jb.SlidingExchange((0, 1)), both, r"\nu_0", 0.36, 0.4, 0.28),
    "SuddenSliding": Case(jb.SuddenSliding(0), both, r"\nu_0", 0.02, 0.1, -0.05),
    "BeltAtRest": Case(
        jb.BeltAtRest(1),
        lambda nu: jb.presets.class_d(-0.47, nu, 0.14, 1.18),
        r"\nu_1",
        0.01,
        -0.05,
        0.05,
    ),
    "FoldOfCycles": Case(jb.FoldOfCycles(), bell_shaped, r"\nu_0", 0.49, 0.49, 0.51),
    "GrazingEdge": Case(jb.GrazingEdge(0), overlapping, r"\sigma_1", 0.5, 0.45, 0.58),
    "CornerCollision": Case(jb.CornerCollision(0), overlapping, r"\sigma_1", 0.61, 0.56, 0.66),
    "BoundaryEquilibrium": Case(
        jb.BoundaryEquilibrium(0), overlapping, r"\sigma_1", 0.73, 0.66, 0.82
    ),
    "PseudoHopf": Case(jb.PseudoHopf(0), overlapping, r"\sigma_1", 0.91, 0.87, 1.0),
    "EdgeExchange": Case(
        jb.EdgeExchange((0, 1)),
        lambda sigma1: beside(sigma1, 0.3, 0.1, 0.4, -0.3),
        r"\sigma_1",
        0.31,
        0.26,
        0.34,
    ),
    "MeetingEdges": Case(
        jb.MeetingEdges((0, 1)),
        lambda sigma1: beside(sigma1, 0.75, 0.5, 0.35, 0.6),
        r"\sigma_1",
        0.76,
        0.72,
        0.79,
    ),
    "SaddleConnection": Case(
        jb.SaddleConnection(1),
        lambda sigma1: jb.presets.class_d(-0.5, 0.5, -0.4, sigma1),
        r"\sigma_1",
        0.3,
        0.22,
        0.36,
        parts=True,
    ),
    "HopfAtInfinity": Case(
        jb.HopfAtInfinity(),
        lambda zeta: jb.Oscillator(zeta, jb.presets.class_a(0.3).belts),
        r"\zeta",
        -0.1,
        0.1,
        -0.3,
    ),
}


def bifurcation(case: Case) -> Figure:
    """Phase portraits before, at and after a point, in one window."""
    point = jb.refine(case.condition, case.make, at=case.guess)
    assert point.status == jb.Status.OK, point
    value = float(point.value)
    print(f"  {point.kind}: {value:.6f}")
    before, after = (jb.portrait(case.make(at)) for at in (case.before, case.after))
    osc = case.make(value)
    cycles = [[*one.cycles, *one.unstable] for one in (before, after)]
    cycles.insert(1, _cycles_at(osc, point, [*before.cycles, *after.cycles]))
    rests = [before.equilibria, _at_the_point(jb.equilibria(osc)), after.equilibria]
    window = _window_of([c for some in cycles for c in some], rests)
    figure = journal_figure(7.2, 3.0)
    axes = figure.subplots(1, 3, sharex=True, sharey=True)
    titles = (f"${case.symbol} = {case.before:g}$", f"${case.symbol} = {value:.5g}$")
    titles = (*titles, f"${case.symbol} = {case.after:g}$")
    oscillators = (before.oscillator, osc, after.oscillator)
    for ax, osc, some, rest, title in zip(axes, oscillators, cycles, rests, titles):
        if case.parts:
            plot_portrait(jb.portrait(osc), ax)
        else:
            jb.plot_phase_portrait(osc, cycles=some, equilibria=rest, ax=ax, **window)
        ax.set_title(title)
        ax.label_outer()
    if (orbit := case.condition.orbit(point)) is not None:
        draw_orbit(axes[1], orbit, "saddle connection")
    draw_key(figure)
    return figure


def _cycles_at(osc: jb.Oscillator, point: jb.BifurcationPoint, beside: list[jb.Cycle]):
    """Cycles at a point: its own, those reached from attracting cycles beside, the unstable one."""
    found = [jb.find_cycle(osc, y0=one.sample(2)[0]) for one in beside]
    found = [point.cycle, *found, jb.unstable_cycle(osc)]
    kept: list[jb.Cycle] = []
    for one in found:
        if int(one.status) == jb.Status.OK:
            # A cycle that is neutral at the point converges slowly and is known to few digits only.
            again = any(abs(float(one.x1_max) - float(other.x1_max)) < 1e-2 for other in kept)
            kept += [] if again else [one]
    return kept


def _at_the_point(rests: jb.Equilibria) -> jb.Equilibria:
    """Equilibria with neutral ones marked as unstable, so that rounding does not decide."""
    neutral = np.abs(np.asarray(rests.rate)) < 1e-6
    return eqx.tree_at(lambda rows: rows.stable, rests, np.asarray(rests.stable) & ~neutral)


def _window_of(cycles: list[jb.Cycle], rests: list[jb.Equilibria]) -> dict:
    """A window that holds all cycles and equilibria, with a margin, and the axis x2 = 0."""
    paths = [np.asarray(cycle.sample(400)) for cycle in cycles]
    ends = [np.asarray(x) for rest in rests for x in (rest.x1_lower, rest.x1_upper)]
    x1 = np.concatenate([*(path[:, 0] for path in paths), *ends])
    x2 = np.concatenate([*(path[:, 1] for path in paths), [0.0]])
    if not paths:
        x2 = np.array([-0.5, 0.5])
    margins = [max(0.08 * np.ptp(x), 0.05) for x in (x1, x2)]
    limits = [(x.min() - margin, x.max() + margin) for x, margin in zip((x1, x2), margins)]
    return {"xlim": limits[0], "ylim": limits[1]}


# --- bifurcations of forced oscillators -----------------------------------------------------------


class ForcedCase(NamedTuple):
    """A kind of bifurcation of periodic motions: oscillators, a guess, and values on both sides.

    start: a state at the phase 0 that leads to the motion at the guess.
    """

    condition: AbstractCondition
    make: Callable
    symbol: str
    guess: float
    before: float
    after: float
    start: tuple[float, float]


def on_a_belt(nu: float, frequency: float, kinetic: float = 0.6) -> Callable:
    """A mass on one belt, as a function of the amplitude of the force."""
    law = jb.Coulomb(1.0, kinetic)
    return lambda F: jb.Oscillator(0.05, (jb.Belt(nu, law),), forcing=jb.Harmonic(F, frequency))


def on_a_cubic_belt(nu: float) -> jb.Oscillator:
    """A forced mass on a belt of velocity `nu` with a cubic law."""
    belts = (jb.Belt(nu, jb.Cubic(1.5, 1.5, 0.45)),)
    return jb.Oscillator(0.0, belts, forcing=jb.Harmonic(0.05, 1.7))


def between_two_belts(frequency: float) -> jb.Oscillator:
    """A forced mass between belts that run in opposite directions."""
    law = jb.Stribeck(1.0, 0.5, 0.3)
    belts = jb.Belt(0.5, law, load=0.2), jb.Belt(-0.5, law, load=0.2)
    return jb.Oscillator(0.05, belts, forcing=jb.Harmonic(1.0, frequency))


FORCED = {
    "PeriodDoubling": ForcedCase(
        *(jb.PeriodDoubling(), jb.presets.di_bernardo, r"\Omega"),
        *(1.73, 1.73, 1.709, (0.5, 0.0)),
    ),
    "Fold": ForcedCase(
        *(jb.Fold(), jb.presets.di_bernardo, r"\Omega", 1.68, 1.67, 1.69, (0.5, 0.0)),
    ),
    "SymmetryBreaking": ForcedCase(
        *(jb.SymmetryBreaking(), between_two_belts, r"\Omega", 0.476, 0.47, 0.49, (0.5, 0.2)),
    ),
    "Torus": ForcedCase(
        *(jb.Torus(), on_a_cubic_belt, r"\nu_0", 1.07, 1.1, 1.04, (1.4, 0.0)),
    ),
    "AddingSliding": ForcedCase(
        *(jb.AddingSliding(0), on_a_belt(0.1, 1.5), "F", 0.95, 0.95, 1.02, (1.0, 0.0)),
    ),
    "SwitchingSliding": ForcedCase(
        *(jb.SwitchingSliding(0), on_a_belt(0.9, 1.3, 1.0), "F", 1.0, 0.9, 1.15, (1.0, 0.0)),
    ),
}


def forced_bifurcation(case: ForcedCase) -> Figure:
    """Attractors before and after a point, and the motion at it, in the plane of x1 and x2."""
    point = jb.refine(case.condition, case.make, at=case.guess, start=case.start)
    assert point.status == jb.Status.OK, point
    value = float(point.value)
    print(f"  {point.kind}: {value:.6f}")
    figure = journal_figure(7.2, 3.0)
    axes = figure.subplots(1, 3, sharex=True, sharey=True)
    for ax, at in zip(axes, (case.before, value, case.after)):
        if at == value:
            point.cycle.plot(ax)
        else:
            _draw_attractor(case.make(at), np.asarray(point.cycle.start), ax)
        ax.set_title(f"${case.symbol} = {at:.5g}$")
        ax.label_outer()
        if ax.get_legend() is not None:
            ax.get_legend().remove()
    draw_key(figure)
    return figure


def _draw_attractor(osc: jb.Oscillator, start: np.ndarray, ax) -> None:
    """Draws the periodic motion that a start leads to, or, where there is none, a long orbit."""
    motion = jb.find_cycle(osc, start)
    if int(motion.status) == jb.Status.OK:
        motion.plot(ax)
        return
    period = 2 * np.pi / float(osc.forcing[0].frequency)
    settled = jb.simulate(osc, start, 400 * period, ts=[400 * period], max_segments=16384).ys[-1]
    ts = np.linspace(0.0, 60 * period, 60 * 64 + 1)
    states = np.asarray(jb.simulate(osc, settled, ts[-1], ts=ts, max_segments=4096).ys)
    ax.plot(*states.T, color="0.5", linewidth=0.4, label="orbit")
    ax.plot(*states[::64].T, "o", color="black", markersize=2, label="phase 0")
    ax.axhline(float(osc.belts[0].velocity), color="#0072B2", linewidth=0.8, label="belt 0")
    ax.set(xlabel="displacement $x_1$", ylabel="velocity $x_2$")


def main(names: list[str]) -> None:
    """Draws the pictures of these names, or all."""
    drawings = {draw.__name__: draw for draw in GALLERY}
    drawings |= {name: lambda case=case: bifurcation(case) for name, case in CASES.items()}
    drawings |= {name: lambda case=case: forced_bifurcation(case) for name, case in FORCED.items()}
    for name in names or drawings:
        print(name, flush=True)
        with journal_style():
            figure = drawings[name]()
            figure.savefig(PICTURES / f"{name}.png", dpi=180, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main(sys.argv[1:])
