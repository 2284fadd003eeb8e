"""Derivatives of a run's final state, by the engine: arc by arc, with the shift of every event.

Along an arc a derivative is that of the flow of one smooth field for a fixed duration, a central
difference, extrapolated. At an event the time shifts by the distance of the disturbed state from
the line over the speed towards it. So no difference is taken across an event, even near grazing.
"""

from dataclasses import replace
from math import isfinite

import numpy as np

from . import engine

#: Disturbances; errors of a difference are about (10 _STEP)^4 near a steep law, and 1e-15 / _STEP.
_STEP = 3e-5


def directions(case, rng):
    """A random direction in which to disturb start and parameters: rates of (y0, damping, belts).

    For each belt: rates of velocity, load, lower and upper edge. Equal numbers have equal rates.
    """
    tied = {}

    def of(name, value):
        return tied.setdefault((name, value), float(rng.uniform(-1, 1))) if isfinite(value) else 0.0

    belts = tuple(
        (
            of("velocity", b.velocity),
            float(rng.uniform(-1, 1)) if b.load else 0.0,
            of("edge", b.lower),
            of("edge", b.upper),
        )
        for b in case.oscillator.belts
    )
    return tuple(rng.uniform(-1, 1, 2).tolist()), float(rng.uniform(-1, 1)), belts


def moved(osc, direction, by):
    _, damping, belts = direction
    return replace(
        osc,
        damping=osc.damping + by * damping,
        belts=tuple(
            replace(
                b,
                velocity=b.velocity + by * v,
                load=b.load + by * u,
                lower=b.lower + by * lo,
                upper=b.upper + by * up,
            )
            for b, (v, u, lo, up) in zip(osc.belts, belts)
        ),
    )


def _difference(f, step, size=1.0):
    """Derivative of f at 0, by Richardson extrapolation; size: disturbance per unit of argument."""
    step = step / max(size, 1.0)
    one, half = ((f(h) - f(-h)) / (2 * h) for h in (step, 0.5 * step))
    return (4 * half - one) / 3


def _onset(osc, mode):
    """x1 where a stick phase ends by slip onset, and the velocity in it."""
    held = sum(b.load * b.law[1] for b, m in zip(osc.belts, mode) if m == 0)
    nu = next(b.velocity for b, m in zip(osc.belts, mode) if m == 0)
    v = nu / osc.omega
    return np.array([engine.force(osc, mode, 0.0, v) + np.sign(v) * held, v])


def derivative(case, run, direction, step=_STEP):
    """d(x1, x2 at T) along a direction; run: the engine's run of the case; step: of differences."""
    osc, delta = case.oscillator, np.array(direction[0])
    y, t, shift = np.array(case.y0, float), 0.0, 0.0
    mode = engine.simulate(osc, case.y0, 1e-12).mode_end

    def along(mode, y, delta, duration):
        # In pieces, each with a step that suits what the disturbance has grown to.
        pieces = int(np.ceil(duration / 0.1))
        for _ in range(pieces):
            # A fast mass passes the steep part of the law in a short time.
            pace = 0.01 / (1 + 0.1 * abs(engine.force(osc, mode, *y)))
            delta = _difference(
                lambda h, y=y, delta=delta, pace=pace: np.array(
                    engine.flow(
                        moved(osc, direction, h), mode, y + h * delta, duration / pieces, pace
                    )
                ),
                step,
                np.max(np.abs(delta)),
            )
            y = np.array(engine.flow(osc, mode, y, duration / pieces, pace))
        return delta

    def field(mode, y):
        return np.array([y[1], engine.force(osc, mode, *y)])

    ends = [*zip(run.t, run.kind, run.belt, run.y, run.codes), (case.T, 0, -1, run.y_end, mode)]
    for t_end, kind, belt, y_end, codes in ends:
        y_end, duration = np.array(y_end), t_end - t
        if 0 in mode:
            d_onset, d_v = _difference(lambda h, m=mode: _onset(moved(osc, direction, h), m), step)
            v = y[1]
            if kind == 0:
                return np.array([delta[0] + d_v * duration - v * shift, d_v])
            d_end = d_onset if kind == engine.SLIP else _edge_shift(osc, direction, y_end[0])
            shift += (d_end - delta[0] - d_v * duration) / v
            delta = np.array([d_end, d_v])
        else:
            delta = along(mode, y, delta, duration) if duration > 0 else delta
            f = field(mode, y_end)
            if kind == 0:
                return delta - f * shift
            if kind == engine.EDGE:
                axis, line = 0, _edge_shift(osc, direction, y_end[0])
            else:
                axis, line = 1, direction[2][belt][0] / osc.omega
            late = (line - delta[axis]) / f[axis]
            delta = delta + f * late
            delta[axis] = line
            shift += late
        y, t, mode = y_end, t_end, tuple(int(c) for c in codes)
    raise AssertionError


def beside(case, direction, by):
    """The case moved along a direction."""
    y0 = tuple(y + by * d for y, d in zip(case.y0, direction[0]))
    return replace(case, oscillator=moved(case.oscillator, direction, by), y0=y0)


def _edge_shift(osc, direction, x1):
    for b, (_, _, lower, upper) in zip(osc.belts, direction[2]):
        if b.lower == x1:
            return lower
        if b.upper == x1:
            return upper
    raise ValueError(f"no edge at {x1}")


def of_period(case, label, direction, step=_STEP):
    """d(period) of the engine's cycle along a direction of the parameters; step: of differences.

    The cycle begins at its maximum of x1, (x1, 0). With M and N the derivatives of the state one
    period later by x1 and along the direction, and f the field there, it stays closed where
    (M - (1, 0)) dx1 + f dT = -N: two equations in dx1 and dT.
    """
    loop = replace(case, y0=label.y, T=label.period)
    run = engine.simulate(case.oscillator, loop.y0, loop.T)
    resting = tuple((0.0, 0.0, 0.0, 0.0) for _ in case.oscillator.belts)
    by_start = derivative(loop, run, ((1.0, 0.0), 0.0, resting), step)
    by_direction = derivative(loop, run, ((0.0, 0.0), *direction[1:]), step)
    x1, x2 = run.y_end
    field = np.array([x2, engine.force(case.oscillator, run.mode_end, x1, x2)])
    matrix = np.column_stack([by_start - np.array([1.0, 0.0]), field])
    return float(np.linalg.solve(matrix, -by_direction)[1])
