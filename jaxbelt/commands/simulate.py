"""`jaxbelt simulate`: one oscillator from one start."""

import csv
import math
from pathlib import Path
from typing import Annotated

import typer

import jaxbelt as jb

from ..spelling import did_you_mean
from .options import (
    Description,
    Json,
    Out,
    Start,
    as_json_value,
    check_number,
    describes,
    make_console,
    outputs,
    plain_errors,
    say,
    tolerances,
    turn_on_float64,
)

FORMULATIONS = ("filippov", "switch", "smooth")


@describes()
def simulate(
    described: Description,
    start: Start = (3.0, 0.0),
    t1: Annotated[float, typer.Option(help="End of the time span, which begins at 0.")] = 100.0,
    samples: Annotated[
        int, typer.Option(help="How many times, evenly spread over the span, are written.")
    ] = 2001,
    formulation: Annotated[
        str,
        typer.Option(
            help="filippov (exact), switch (the paper's switch model) or smooth (tanh for sgn)."
        ),
    ] = "filippov",
    v_star: Annotated[float, typer.Option(help="Half-width of the switch model's band.")] = 1e-3,
    eps: Annotated[float, typer.Option(help="Width of the smooth model's tanh.")] = 1e-3,
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="Relative and absolute tolerance of the integrator.",
            show_default="1e-10, the absolute one of the oscillator's own size",
        ),
    ] = None,
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
    unless given), coulomb (static, kinetic) and stribeck (static, kinetic, stribeck_velocity).

    Examples:

    - jaxbelt simulate --class a --nu0 0.2 --start 1.5 0 --t1 60

    - jaxbelt simulate --class d --nu1 -0.3 --sigma0 0 --sigma1 0.5 --out overlap

    - jaxbelt simulate --belt 0.3 --belt 0.5,law=coulomb,static=0.8,kinetic=0.5,lower=0.2
    """
    console = make_console()
    with plain_errors():
        if samples < 2:
            raise ValueError(f"samples must be at least 2, got {samples}")
        if formulation not in FORMULATIONS:
            meant = did_you_mean(formulation, FORMULATIONS)
            names = ", ".join(FORMULATIONS)
            raise ValueError(f"formulation must be one of {names}, got {formulation}{meant}")
        check_number("t1", t1)
        asked = tolerances(tolerance)
        if not all(map(math.isfinite, start)):
            raise ValueError(f"start must be finite, got {start[0]} {start[1]}")
        written = outputs(out, ".png", ".csv", "_events.csv")
        described.check()
        turn_on_float64()
        import numpy as np

        osc = described.oscillator()
        trajectory = jb.simulate(
            osc,
            start,
            t1,
            ts=np.array([t1 * i / (samples - 1) for i in range(samples)]),
            **asked,
            formulation=formulation,
            v_star=v_star,
            eps=eps,
        )
        from ..model.oscillator import has_clock
        from ..paper import steady_cycle
        from ..plotting.phase import draw_overview
        from ..plotting.style import journal_style, save

        out.parent.mkdir(parents=True, exist_ok=True)
        # With a clock a state that comes back is not yet a motion that repeats.
        cycle = None if has_clock(osc) else steady_cycle(trajectory)
        with journal_style():
            figure = draw_overview(osc, trajectory, cycles=[cycle] if cycle else [])
            save(figure, written[0])
        write_samples(trajectory, written[1])
        write_events(trajectory, written[2])
    data = {
        "status": jb.Status(int(trajectory.status)).name,
        "t": as_json_value(trajectory.ts[-1]),
        "x1": as_json_value(trajectory.ys[-1, 0]),
        "x2": as_json_value(trajectory.ys[-1, 1]),
        "events": len(trajectory.events.t),
    }
    say(console, [repr(trajectory)], written, as_json=as_json, data=data)
    if int(trajectory.status) >= jb.Status.TOO_MANY_SEGMENTS:
        raise typer.Exit(1)


def write_samples(trajectory: "jb.Trajectory", path: Path) -> None:
    """Writes t, x1, x2 and the contact code of every belt, a row for each sample, to the last
    digit."""
    modes = trajectory.modes
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "x1", "x2", *(f"mode{i}" for i in range(modes.shape[1]))])
        ts, ys = trajectory.ts.tolist(), trajectory.ys.tolist()
        for t, y, mode in zip(ts, ys, modes.tolist(), strict=True):
            writer.writerow([t, *y, *mode])


def write_events(trajectory: "jb.Trajectory", path: Path) -> None:
    """Writes t, x1, x2, kind and belt, a row for each event."""
    events = trajectory.events
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "x1", "x2", "kind", "belt"])
        columns = events.t.tolist(), events.y.tolist()
        kinds = [jb.EventKind(kind).name for kind in events.kind.tolist()]
        for t, y, kind, belt in zip(*columns, kinds, events.belt.tolist(), strict=True):
            writer.writerow([t, *y, kind, belt])
