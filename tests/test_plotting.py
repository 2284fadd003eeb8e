"""Pictures show what the results hold: spans, boundaries, stability; and touch nothing else."""

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.text import Text

import jaxbelt as jb
from jaxbelt import paper as reproduce
from jaxbelt.bifurcations.pieces import Branch
from jaxbelt.cycles.chains import Chain
from jaxbelt.motion.arcs import Ends
from jaxbelt.plotting.histories import stick_phases
from jaxbelt.plotting.phase import _vector_field, draw_overview
from jaxbelt.plotting.style import BELT_COLOURS, journal_style, key_entries, save


def run(nu0: float, start=(3.0, 0.0)) -> jb.Trajectory:
    """Class (b) with nu1 = 0.35, in the shapes of test_cli: one compiled program serves all."""
    times = np.linspace(0.0, 50.0, 401)
    return jb.simulate(jb.presets.class_b(nu0, 0.35), start, 50.0, ts=times)


@pytest.fixture(scope="module")
def two_sided():
    """Where the steady cycle sticks to both belts in turn."""
    return jb.presets.class_b(-0.2, 0.35), run(-0.2)


def spans(ax):
    """(begin, end) of the shaded spans of some axes, in order."""
    boxes = [path.get_extents() for shades in ax.collections for path in shades.get_paths()]
    return sorted((box.x0, box.x1) for box in boxes)


def states(artist) -> np.ndarray:
    """The points of a drawn line, [n, 2]."""
    return np.asarray(artist.get_xydata())


def line(ax, label: str):
    (found,) = (artist for artist in ax.get_lines() if artist.get_label() == label)
    return found


def test_stick_phases_are_those_of_the_events(two_sided):
    _, trajectory = two_sided
    events = trajectory.events
    sticks = np.flatnonzero(events.kind == jb.EventKind.STICK)
    # Both belts always touch, so what follows STICK is its SLIP, or the end of the run.
    ends = np.append(np.asarray(events.t), trajectory.ts[-1])[sticks + 1]
    phases = stick_phases(trajectory)
    assert {belt for belt, *_ in phases} == {0, 1}
    assert [belt for belt, *_ in phases] == events.belt[sticks].tolist()
    np.testing.assert_allclose([begin for _, begin, _ in phases], events.t[sticks], atol=1e-12)
    # The begin of an arc plus its duration is the time of its event, but for rounding.
    np.testing.assert_allclose([end for *_, end in phases], ends, atol=1e-12)


def test_time_history_shades_every_stick_phase_in_the_colour_of_its_belt(two_sided):
    _, trajectory = two_sided
    axes = jb.plot_time_history(trajectory)
    phases = stick_phases(trajectory)
    for ax in axes:
        np.testing.assert_allclose(spans(ax), [phase[1:] for phase in phases])
    labels = set(axes[0].get_legend_handles_labels()[1])
    assert labels == {"sticks to belt 0", "sticks to belt 1"}
    assert len(np.unique([shades.get_facecolor() for shades in axes[0].collections], axis=0)) == 2
    (x1,) = axes[0].get_lines()
    np.testing.assert_array_equal(np.interp(trajectory.ts, *states(x1).T), trajectory.ys[:, 0])
    assert [ax.get_ylabel() for ax in axes] == ["displacement $x_1$", "velocity $x_2$"]


@pytest.mark.filterwarnings("error")
def test_many_stick_phases_are_one_artist_of_their_belt(two_sided):
    """With one for each, a picture of 100,000 phases took minutes."""
    osc, trajectory = two_sided
    number = 20_000
    t = jnp.linspace(0.0, 50.0, number, endpoint=False)
    codes = jnp.array([[0, 1], [1, 1], [-1, 0], [-1, -1]], dtype=jnp.int8)
    modes = jnp.tile(codes, (number // 4, 1))
    arcs = jb.Arcs(t, jnp.zeros((number, 2)), modes, jnp.full(number, 50.0 / number))
    many = eqx.tree_at(lambda run: run.arcs, trajectory, arcs)
    phases = stick_phases(many)
    assert len(phases) == number / 2
    for ax in (*draw_overview(osc, many).axes[:2], many.plot()):
        assert len(ax.collections) == 2 and not ax.patches
        np.testing.assert_allclose(spans(ax), [phase[1:] for phase in phases])


def test_the_key_of_a_trajectory_has_the_belts_in_order(two_sided):
    _, trajectory = two_sided
    arcs = eqx.tree_at(lambda a: a.mode, trajectory.arcs, trajectory.arcs.mode[:, ::-1])
    swapped = eqx.tree_at(lambda run: run.arcs, trajectory, arcs)
    firsts = {stick_phases(run)[0][0] for run in (trajectory, swapped)}
    assert firsts == {0, 1}
    for run in (trajectory, swapped):
        words = [text.get_text() for text in run.plot().get_legend().get_texts()]
        assert words[-2:] == ["sticks to belt 0", "sticks to belt 1"]


def test_a_stick_phase_across_a_contact_edge_is_one(two_sided):
    arcs = jb.Arcs(
        t=jnp.array([0.0, 1.0, 3.0, 4.0, jnp.nan]),
        y=jnp.zeros((5, 2)),
        mode=jnp.array([[0, -2], [0, 1], [1, 1], [1, 0], [0, 0]], dtype=jnp.int8),
        duration=jnp.array([1.0, 2.0, 1.0, 0.5, jnp.nan]),
    )
    _, trajectory = two_sided
    made = eqx.tree_at(lambda run: run.arcs, trajectory, arcs)
    assert stick_phases(made) == [(0, 0.0, 3.0), (1, 4.0, 4.5)]


def test_padding_is_not_drawn(two_sided):
    """A lane of a batch is padded with NaN, its kinds and modes with zeros."""
    osc, trajectory = two_sided

    def pad(leaf):
        blank = jnp.nan if jnp.issubdtype(leaf.dtype, jnp.inexact) else 0
        return jnp.concatenate([leaf, jnp.full((3, *leaf.shape[1:]), blank, leaf.dtype)])

    lane = eqx.tree_at(
        lambda run: (run.events, run.arcs),
        trajectory,
        jax.tree.map(pad, (trajectory.events, trajectory.arcs)),
    )
    assert stick_phases(lane) == stick_phases(trajectory)
    alone, padded = (jb.plot_phase_portrait(osc, drawn) for drawn in (trajectory, lane))
    np.testing.assert_array_equal(states(line(padded, "orbit")), states(line(alone, "orbit")))
    assert len(states(line(alone, "orbit"))) == 401 + trajectory.events.t.size


def test_a_run_without_finite_samples_is_named_with_its_status(two_sided):
    osc, trajectory = two_sided
    nothing, status = jnp.full_like(trajectory.ys, jnp.nan), jnp.asarray(jb.Status.NOT_FINITE.value)
    lost = eqx.tree_at(lambda one: (one.ys, one.status), trajectory, (nothing, status))
    events = eqx.tree_at(lambda one: one.y, lost.events, jnp.full_like(lost.events.y, jnp.nan))
    lost = eqx.tree_at(lambda one: one.events, lost, events)
    draws = {
        "trajectories": lambda: jb.plot_phase_portrait(osc, [trajectory, lost]),
        "trajectory": lambda: jb.plot_time_history(lost),
        "traj": lost.plot,
    }
    for field, draw in draws.items():
        with pytest.raises(ValueError, match=f"^{field}.* finite samples, .*status NOT_FINITE: "):
            draw()
    assert not plt.get_fignums()


def test_without_arcs_the_samples_tell_what_sticks(two_sided):
    _, exact = two_sided
    nothing = jax.tree.map(lambda leaf: leaf[:0], exact.arcs)
    trajectory = eqx.tree_at(lambda run: run.arcs, exact, nothing)
    np.testing.assert_allclose(
        [phase[1:] for phase in stick_phases(trajectory)],
        [phase[1:] for phase in stick_phases(exact)],
        atol=50.0 / 400,
    )


def test_phase_portrait_draws_boundaries_over_their_contact_intervals():
    osc = jb.presets.class_d(0.2, -0.3, 0.0, 0.5)
    ax = jb.plot_phase_portrait(osc, xlim=(-2.0, 2.0), ylim=(-1.0, 1.0))
    boundaries = {
        colour: [
            states(artist).tolist()
            for artist in ax.get_lines()
            if artist.get_color() == colour and len(states(artist)) == 2
        ]
        for colour in BELT_COLOURS[:2]
    }
    assert boundaries[BELT_COLOURS[0]] == [[[-2.0, 0.2], [0.5, 0.2]]]
    assert boundaries[BELT_COLOURS[1]] == [[[0.0, -0.3], [2.0, -0.3]]]
    names = {text.get_text() for text in ax.texts}
    assert {r"$\Sigma_{\mathrm{F}0}$", r"$\Sigma_{\mathrm{F}1}$"} <= names
    assert {r"$\sigma_{0}$", r"$\sigma_{1}$"} <= names


def test_names_of_edges_do_not_touch():
    close = jb.presets.class_d(0.2, -0.3, -0.02, 0.02)
    ax = jb.plot_phase_portrait(close, xlim=(-2.0, 2.0), ylim=(-1.0, 1.0))
    ax.figure.canvas.draw()
    first, second = (
        next(t for t in ax.texts if t.get_text() == name).get_window_extent()
        for name in (r"$\sigma_{0}$", r"$\sigma_{1}$")
    )
    assert not first.overlaps(second)


def key_colours(ax, label):
    """The colours in which the key of some axes shows a thing."""
    (handles,) = (handles for name, handles in key_entries([ax]).items() if name == label)
    return [handle.get_color() for handle in handles]


def test_the_sliding_set_is_where_the_contact_holds():
    nu0 = 0.2
    ax = jb.plot_phase_portrait(jb.presets.class_a(nu0), xlim=(-3.0, 3.0))
    # Its key has its colour.
    drawn = line(ax, "sliding set")
    assert drawn.get_color() == BELT_COLOURS[0]
    assert key_colours(ax, "sliding set") == [BELT_COLOURS[0]]
    both = jb.plot_phase_portrait(jb.presets.class_b(-0.2, 0.35), xlim=(-3.0, 3.0))
    assert key_colours(both, "sliding set") == [*BELT_COLOURS[:2]]
    x1, band = states(drawn).T
    # Eq. (10): |-x1 - zeta nu0| < u0 mus, here with u0 = mus = omega = 1.
    np.testing.assert_array_equal(np.isfinite(band), np.abs(-x1 - 0.5 * nu0) < 1)


def test_names_of_close_boundaries_keep_apart():
    ax = jb.plot_phase_portrait(jb.presets.class_b(0.35, 0.35))
    ax.figure.canvas.draw()
    boxes = [text.get_window_extent() for text in ax.texts if "Sigma" in text.get_text()]
    assert len(boxes) == 2
    assert not boxes[0].overlaps(boxes[1])


class Loop:
    """A cycle to draw."""

    def __init__(self, radius: float, stable: bool):
        self.radius, self.stable = radius, stable

    def sample(self, n: int):
        angle = np.linspace(0, 2 * np.pi, n)
        return self.radius * np.column_stack([np.cos(angle), np.sin(angle)])


@pytest.mark.slow(first=True)
def test_drawn_cycles_pass_through_their_corners():
    osc = jb.presets.class_b(0.1, 0.35)
    cycle = jb.find_cycle(osc, (3.0, 0.0))
    drawn = states(line(jb.plot_phase_portrait(osc, cycles=[cycle]), "stable cycle"))
    for entry in np.asarray(cycle.arcs.y):
        assert np.min(np.hypot(*(drawn - entry).T)) < 1e-12
    # In order: nowhere does the line go back and forth.
    steps = np.hypot(*np.diff(drawn, axis=0).T)
    once = np.hypot(*np.diff(np.asarray(cycle.sample(4000)), axis=0).T)
    assert np.sum(steps) == pytest.approx(np.sum(once), rel=1e-3)


def test_stability_shows():
    osc = jb.presets.class_b(0.45, 0.35)
    ax = jb.plot_phase_portrait(osc, cycles=[Loop(0.5, True), Loop(0.3, False)])
    assert line(ax, "stable cycle").get_linestyle() == "-"
    assert line(ax, "unstable cycle").get_linestyle() == "--"
    assert line(ax, "stable fixed point").get_markerfacecolor() == "black"
    ((x1, x2),) = states(line(ax, "stable fixed point"))
    # Eq. (24) with both belts.
    assert x1 == pytest.approx(1.2 + 0.4 / 5.5 + 0.4 / 4.5, abs=1e-12)
    assert x2 == 0
    unstable = jb.plot_phase_portrait(jb.presets.class_a(0.1))
    assert line(unstable, "unstable fixed point").get_markerfacecolor() == "white"
    centre = jb.Oscillator(0.0, (jb.Belt(1.0, jb.Coulomb(1.0, 0.6)),))
    assert line(jb.plot_phase_portrait(centre), "neutral fixed point")


def test_segment_and_pseudo_focus():
    ax = jb.plot_phase_portrait(jb.presets.class_b(0.0, 0.35))
    middle = 0.6 + 0.4 / 4.5
    ends = states(line(ax, "pseudo-equilibria"))[:, 0]
    np.testing.assert_allclose(ends, [middle - 1, middle + 1], atol=1e-12)
    ax = jb.plot_phase_portrait(jb.presets.class_c(0.3, -0.4, 0.1))
    (focus,) = (artist for artist in ax.get_lines() if "pseudo-focus" in str(artist.get_label()))
    assert focus.get_xdata() == [0.1]


@pytest.mark.parametrize("kind", ["streamlines", "arrows"])
def test_vector_field_jumps_at_the_boundary_and_slides_on_it(kind):
    osc = jb.presets.class_a(0.3)
    ax = jb.plot_vector_field(osc, kind=kind, xlim=(-2.0, 2.0), ylim=(-1.0, 1.0))
    assert ax.collections
    x2 = jnp.array([0.3 - 1e-9, 0.3, 0.3 + 1e-9])
    x1_dot, x2_dot = _vector_field(osc, jnp.zeros(3), x2)
    np.testing.assert_array_equal(x1_dot, x2)
    # -zeta nu0 + mus, stuck, -zeta nu0 - mus
    np.testing.assert_allclose(x2_dot, [0.85, 0.0, -1.15], atol=1e-7)


def test_vector_field_refuses_an_unknown_kind():
    with pytest.raises(ValueError, match='kind must be "streamlines" or "arrows", got \'dots\''):
        jb.plot_vector_field(jb.presets.class_a(0.3), kind="dots")


def test_friction_law():
    ax = jb.plot_friction_law(jb.presets.paper_friction(), speed=0.5)
    assert ax.get_xlim() == (-0.5, 0.5)
    curves = [points for points in map(states, ax.get_lines()) if len(points) == 401]
    np.testing.assert_allclose(curves[0][-1], [0.5, 0.6 + 0.4 / 6])
    np.testing.assert_allclose(curves[1][-1], [-0.5, -0.6 - 0.4 / 6])


def test_pictures_leave_the_settings_and_windows_of_matplotlib_alone(two_sided, tmp_path):
    osc, trajectory = two_sided
    before = dict(plt.rcParams)
    with journal_style():
        figure = draw_overview(osc, trajectory)
        save(figure, tmp_path / "overview.png")
    assert (tmp_path / "overview.png").read_bytes().startswith(b"\x89PNG")
    assert dict(plt.rcParams) == before
    assert plt.get_fignums() == []


# --- the steady cycles of the reproduction -------------------------------------------------------


def test_steady_cycle_is_closed_and_sticks(two_sided):
    _, trajectory = two_sided
    cycle = reproduce.steady_cycle(trajectory)
    assert cycle is not None
    np.testing.assert_allclose(cycle.states[0], cycle.states[-1], atol=1e-9)
    # It reaches both belts and stays between them.
    assert cycle.states[:, 1].min() == pytest.approx(-0.2, abs=1e-12)
    assert cycle.states[:, 1].max() == pytest.approx(0.35, abs=1e-12)


def test_the_steady_cycle_lasts_from_the_last_onset_but_one_to_the_last(two_sided):
    _, trajectory = two_sided
    events = trajectory.events
    t, y = np.asarray(events.t), np.asarray(events.y)
    slips = np.flatnonzero(events.kind == jb.EventKind.SLIP)
    last = slips[-1]
    before = next(i for i in slips[-2::-1] if np.allclose(y[i], y[last], atol=1e-6))
    inside = (trajectory.ts >= t[before]) & (trajectory.ts <= t[last])
    cycle = reproduce.steady_cycle(trajectory)
    assert cycle is not None
    states = cycle.states
    assert len(states) == np.sum(inside) + last - before + 1
    np.testing.assert_array_equal(states[[0, -1]], y[[before, last]])


def test_no_steady_cycle_where_the_mass_comes_to_rest():
    assert reproduce.steady_cycle(run(0.7)) is None


def test_class_a_is_the_limit_of_two_belts():
    osc = jb.presets.class_a(0.23)
    x1, x2 = np.random.default_rng(0).uniform(-3, 3, (2, 50))
    alone, beside = (_vector_field(o, x1, x2) for o in (osc, reproduce._with_two_belts(osc)))
    np.testing.assert_array_equal(alone, beside)


def test_missing_region_below_nu_delta():
    """Between nu0 = 0 and a grazing point near -0.0788 the cycle sticks on belt 0 only."""
    belts = {}
    for nu0 in (-0.07, -0.09):
        events = run(nu0, start=(0.1, 0.0)).events
        sticks = (events.t > 20) & (events.kind == jb.EventKind.STICK)
        belts[nu0] = set(events.belt[sticks].tolist())
    assert belts == {-0.07: {0}, -0.09: {0, 1}}


def made_up_diagram(values=(0.10, 0.1355, 0.139, 0.1458, 0.1488, 0.1569, 0.28)):
    """A diagram of one equilibrium, with points at these values; not in their order."""
    osc = jb.presets.class_a(0.3)
    rows = np.linspace(0.0, 0.3, 5)
    nothing = np.full(5, np.nan)
    extent = (np.full(5, 0.7), np.full(5, 0.7), np.zeros(5), np.zeros(5))
    branch = Branch(
        *("equilibrium", rows, np.ones(5, bool), np.zeros(5, bool), *extent, nothing, nothing),
        *(nothing[:, None], nothing[:, None], ()),
    )
    nan = jnp.asarray(jnp.nan)
    chain = Chain(jnp.ones((1, 1)), jnp.full(1, Ends(1).unused), jnp.zeros((1, 1)))
    cycle = jb.Cycle(osc, chain, jnp.full((1, 3), nan), nan, nan, nan, jnp.asarray(0))
    kinds = [jb.Hopf(), *[jb.CrossingSliding(belt=0), jb.NonsmoothFold(belt=1)] * 3]
    points = [
        jb.BifurcationPoint(kind, jnp.asarray(value), *[nan] * 6, osc, cycle, jnp.asarray(0))
        for kind, value in zip(kinds, values)
    ]
    regions = ((0.0, 0.3, "1"),)
    return jb.BifurcationDiagram(
        (*points[3:], *points[:3]), (branch,), regions, osc, "belts[0].velocity", False
    )


def made_up_sweep():
    words = "equilibrium cycle stuck undecided".split()
    told = {"flag_values": np.arange(4), "flag_meanings": " ".join(words)}
    kinds = np.arange(16).reshape(4, 4) % 4
    axes = {"nu0": np.linspace(0.0, 1.0, 4), "nu1": np.linspace(0.0, 1.0, 4)}
    return xr.Dataset({"kind": (("nu0", "nu1"), kinds, told)}, axes)


def made_up_fractions():
    values, shares = np.linspace(0.1, 0.3, 3), np.array([[0.5, 0.5]] * 3)
    return jb.BasinFractions(
        *(values, ("cycle 0", "equilibrium 0"), shares, shares / 50, 0 * values),
        *([shares] * 5),
        *(100, "nu0", True),
    )


@pytest.mark.parametrize(
    "draw",
    [
        lambda ax: jb.plot_sweep(made_up_sweep(), "kind", ax=ax),
        lambda ax: made_up_fractions().plot(ax),
        lambda ax: made_up_diagram().plot(ax),
    ],
)
def test_what_stands_beside_axes_of_ones_own_is_within_the_figure(draw):
    """A figure as pyplot makes it, and what is saved of it."""
    figure, ax = plt.subplots()
    draw(ax)
    figure.canvas.draw()
    page, renderer = figure.bbox, figure.canvas.get_renderer()
    keys = [key for key in (ax.get_legend(), *figure.legends) if key]
    names = [text for text in ax.texts if text.get_text()]
    assert keys or names
    for artist in (*keys, *names, ax.xaxis, ax.yaxis):
        box = artist.get_tightbbox(renderer)
        # A pixel more is the width of a line.
        assert min(box.x0 - page.x0, box.y0 - page.y0) > -1, artist
        assert min(page.x1 - box.x1, page.y1 - box.y1) > -1, artist
    for key in keys:
        assert not key.get_tightbbox(renderer).overlaps(ax.xaxis.get_tightbbox(renderer))


def test_a_layout_that_a_figure_has_is_kept():
    figure, ax = plt.subplots(layout="tight")
    before = figure.get_layout_engine()
    made_up_fractions().plot(ax)
    assert figure.get_layout_engine() is before


def test_lines_to_the_names_of_points_do_not_cross_and_names_do_not_overlap():
    ax = made_up_diagram().plot()
    ax.figure.canvas.draw()
    names = [text for text in ax.texts if text.get_text()]
    values = [text.xy[0] for text in names]
    boxes = [Text.get_window_extent(text) for text in names]  # without its line
    order = np.argsort(values)
    lefts, rights = (np.array([getattr(box, end) for box in boxes])[order] for end in ("x0", "x1"))
    assert len(names) == 7 and np.all(lefts[1:] > rights[:-1])


def test_a_phase_portrait_has_a_key(two_sided):
    osc, trajectory = two_sided
    key = jb.plot_phase_portrait(osc, trajectory).get_legend()
    labels = {text.get_text() for text in key.get_texts()}
    assert {"orbit", "sliding set", "unstable fixed point"} <= labels
    _, ax = plt.subplots()
    assert jb.plot_phase_portrait(osc, trajectory, ax=ax).get_legend() is None


def test_what_a_table_does_not_cover_is_dashed():
    law = jb.Tabulated([0.0, 0.1, 0.5], [0.8, 0.6, 0.5])
    ax = jb.plot_friction_law(law)
    assert ax.get_xlim() == (-0.5, 0.5) and ax.get_legend() is None  # nothing is extrapolated
    ax = jb.plot_friction_law(law, speed=1.0)
    beyond = line(ax, "extrapolated")
    assert beyond.get_linestyle() == "--" and ax.get_legend() is not None
    r, mu = beyond.get_xdata(), beyond.get_ydata()
    assert (r[0], r[-1]) == (0.5, 1.0) and mu[0] == pytest.approx(0.5, abs=1e-9)
    solid = [one for one in ax.lines if one.get_linestyle() == "-" and len(one.get_xdata()) > 2]
    assert max(np.max(np.abs(one.get_xdata())) for one in solid) == 0.5


def test_a_law_of_a_physical_belt_is_in_its_unit():
    belt = jb.PhysicalBelt(0.02, jb.Conti(0.4, 0.25, 100.0), 5.0)
    assert jb.plot_friction_law(belt, speed=0.1).get_xlabel() == "relative velocity $R$ (m/s)"


@pytest.mark.slow(first=True)
def test_a_sweep_of_attractors_says_that_one_start_was_asked():
    """Class (a) rests or sticks, by its start, between its Hopf point and its fold."""
    nus = np.array([0.15, 0.22, 0.3])
    one = jb.sweep(jb.presets.class_a, {"nu0": nus}, y0=(0.7, 0.1), observe="attractor")
    assert one.attrs["start"].startswith("x1 = 0.7, x2 = 0.1: of several attractors the one")
    ax = jb.plot_sweep(one, "stick_duration")
    assert ax.get_title() == "from one start, x1 = 0.7, x2 = 0.1"
    assert ax.get_xlim()[0] < 0.15 and ax.get_xlim()[1] > 0.3  # also where there is no cycle
    axes = {"nu0": nus, "x1": np.array([0.7, 3.0, 3.5]), "x2": [0.0]}
    several = jb.sweep(jb.presets.class_a, axes, observe="attractor")
    ax = jb.plot_sweep(several, "kind", share="cycle")
    assert ax.get_title() == "" and ax.get_ylabel() == "share of starts: cycle"
    shares = ax.lines[0].get_ydata()
    assert shares[0] == 1.0 and 0 < shares[1] < 1 and shares[2] == 0.0
    for dataset, share in ((one, "cycle"), (several, "circle")):
        with pytest.raises(ValueError, match="share must be"):
            jb.plot_sweep(dataset, "kind", share=share)


def test_a_friction_law_in_units_of_its_own():
    ax = jb.plot_friction_law(jb.Conti(0.4, 0.25, 100.0), speed=0.1, unit="m/s")
    assert ax.get_xlabel() == "relative velocity $R$ (m/s)"
    belt = jb.PhysicalBelt(0.02, jb.Conti(0.4, 0.25, 100.0), 5.0)
    machine = jb.Machine(0.5, 2000.0, 1.0, (belt,))
    with pytest.raises(ValueError, match="result must be a picture with an axis of time"):
        jb.plot_in_si(ax, machine)  # it is in SI units
