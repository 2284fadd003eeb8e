"""`jaxbelt simulate`: one oscillator from one start."""

from pathlib import Path
from typing import Annotated, Any

import typer

import jaxbelt as jb

from .description import Description, describes
from .options import (
    Json,
    Out,
    Start,
    as_json_value,
    check_count,
    check_number,
    check_word,
    option,
    outputs,
    plain_errors,
    say,
    tolerance_of,
    tolerances,
    turn_on_float64,
)
from .tables import in_columns, write_columns


@describes()
def simulate(
    described: Description,
    start: Start = None,
    t1: Annotated[
        float | None,
        option("End of the time span, which begins at 0; of a machine in s.", "100, dimensionless"),
    ] = None,
    samples: Annotated[
        int, typer.Option(help="How many times, evenly spread over the span, are written.")
    ] = 2001,
    formulation: Annotated[
        str,
        typer.Option(
            help="filippov (exact), switch (the paper's switch model) or smooth (tanh for sgn)."
        ),
    ] = "filippov",
    v_star: Annotated[
        float | None,
        option("Half-width of the switch model's band, a velocity.", "1e-3 of its own size"),
    ] = None,
    eps: Annotated[
        float | None, option("Width of the smooth model's tanh, likewise.", "1e-3 of its own size")
    ] = None,
    tolerance: Annotated[float | None, tolerance_of("1e-10")] = None,
    out: Out = Path("trajectory"),
    as_json: Json = False,
) -> None:
    """Follow one oscillator from one start; write a picture and the numbers.

    Takes some seconds, mostly to compile.

    - **OUT.png**: time histories with the stick phases shaded, and the phase portrait.

    - **OUT.csv**: t, x1, x2 and the contact of each belt: 1 or -1 slip with that sign of the
      relative velocity nu - omega x2, 0 stuck, -2 or 2 the mass below or above the belt's interval.

    - **OUT_events.csv**: t, x1, x2, kind (STICK, SLIP, CROSS, EDGE) and belt of every event.

    The classes have the friction of the paper (Conti's law, mus = 1, p1 = 0.6, p3 = 10):

    - a: one belt. Give --nu0.

    - b: two belts that always touch. Give --nu0 --nu1.

    - c: belt 0 below sigma, belt 1 above it. Give --nu0 --nu1 --sigma.

    - d: belt 0 below sigma1, belt 1 above sigma0. Give --nu0 --nu1 --sigma0 --sigma1.

    The laws of a --belt are conti (static, residual, steepness, quadratic; those of the paper
    unless given), coulomb (static, kinetic), stribeck (static, kinetic, stribeck_velocity) and
    cubic (a0, a1, a3).

    A --file has the arguments of the Python classes: of Machine and PhysicalBelt in SI units, as
    here, or without mass and stiffness those of Oscillator and Belt. With a machine all that is
    given and written is in SI units.

    ```toml
    mass = 1.2
    stiffness = 300.0
    damping = 4.0

    [[belts]]
    velocity = 0.12
    normal_force = { mean = 20.0, amplitude = 5.0, frequency = 14.0 }
    [belts.friction]
    law = "stribeck"    # or conti, coulomb, cubic
    static = 0.5
    kinetic = 0.3
    velocity = 0.05

    [[belts]]
    velocity = 0.1
    normal_force = 10.0
    lower = 0.02
    friction = { law = "table", file = "mu.csv" }    # columns: speed, mu

    [[forcing]]
    kind = "harmonic"    # or base_motion
    amplitude = 3.0
    frequency = 14.0     # in rad/s
    ```

    Examples:

    - jaxbelt simulate --class a --nu0 0.2 --start 1.5 0 --t1 60

    - jaxbelt simulate --class d --nu1 -0.3 --sigma0 0 --sigma1 0.5 --out overlap

    - jaxbelt simulate --belt 0.3 --belt 0.5,law=coulomb,static=0.8,kinetic=0.5,lower=0.2

    - jaxbelt simulate --file machine.toml --start 0.05 0 --t1 4
    """
    with plain_errors():
        check_count("samples", samples, 2)
        check_word("formulation", formulation, ("filippov", "switch", "smooth"))
        if t1 is not None:
            check_number("t1", t1)
        asked: dict[str, Any] = tolerances(tolerance)
        written = outputs(out, ".png", ".csv", "_events.csv")
        described.check()
        y0, machine = described.start(start), described.machine
        end = 100.0 if t1 is None else described.dimensionless(t1, "time")
        for name, width, of in (("v-star", v_star, "switch"), ("eps", eps, "smooth")):
            if width is not None:
                check_number(name, width)
                if formulation != of:
                    unless = f"left out unless --formulation is {of}"
                    raise ValueError(f"{name} must be {unless}, got {width}")
                width = described.dimensionless(width, "velocity")
            asked[name.replace("-", "_")] = width
        turn_on_float64()
        import numpy as np

        osc = described.oscillator()
        ts = np.linspace(0.0, end, samples)
        trajectory = jb.simulate(osc, y0, end, ts=ts, formulation=formulation, **asked)
        from ..model.oscillator import has_clock
        from ..paper import steady_cycle
        from ..plotting.phase import draw_overview
        from ..plotting.style import journal_style, save

        out.parent.mkdir(parents=True, exist_ok=True)
        # With a clock a state may recur at another phase: that is not yet a periodic motion.
        cycle = None if has_clock(osc) else steady_cycle(trajectory)
        with journal_style():
            figure = draw_overview(osc, trajectory, cycles=[cycle] if cycle else [])
            if machine:
                jb.plot_in_si(figure.axes, machine)
            save(figure, written[0])
        found = jb.in_si(trajectory, machine) if machine else None
        columns = columns_of_samples(trajectory, found)
        write_columns(columns, written[1])
        write_columns(columns_of_events(trajectory, found), written[2])
    status = jb.Status(int(trajectory.status))
    last = {name: as_json_value(column[-1]) for name, column in list(columns.items())[:3]}
    data = {"status": status.name, **last, "events": len(trajectory.events.t)}
    lines = [repr(trajectory)]
    if machine:
        ends = ", ".join(f"{name} {value:.6g}" for name, value in last.items() if value is not None)
        lines = [f"ends at {ends}; {trajectory.events!r}, status {status.name}: "]
        lines[0] += jb.describe(trajectory.status)
    say(lines, written, as_json=as_json, data=data)
    if int(trajectory.status) >= jb.Status.TOO_MANY_SEGMENTS:
        raise typer.Exit(1)


def columns_of_samples(trajectory: "jb.Trajectory", found: Any = None) -> dict[str, Any]:
    """Columns t, x1, x2 and the contact code of every belt, a row for each sample.

    found: the trajectory in SI units; columns then have units, and the friction force is added.
    """
    columns = dict(t=trajectory.ts, x1=trajectory.ys[:, 0], x2=trajectory.ys[:, 1])
    if found is not None:
        columns = in_columns(found, [name for name in (*columns, "force") if name in found])
    modes = zip(*trajectory.modes.tolist(), strict=True)
    return columns | {f"mode{i}": mode for i, mode in enumerate(modes)}


def columns_of_events(trajectory: "jb.Trajectory", found: Any = None) -> dict[str, Any]:
    """Columns t, x1, x2, kind and belt, a row for each event; found: see `columns_of_samples`."""
    events = trajectory.events
    columns = dict(t=events.t, x1=events.y[:, 0], x2=events.y[:, 1])
    if found is not None:
        in_si = in_columns(found, [f"{name}_event" for name in columns])
        columns = {name.replace("_event", ""): column for name, column in in_si.items()}
    kinds = [jb.EventKind(kind).name for kind in events.kind.tolist()]
    return columns | {"kind": kinds, "belt": events.belt}
