"""Curves whose equations are known, every way in which one can end; and even values."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbelt.numerics.continuation import Stop, continue_curve, corrected
from jaxbelt.numerics.spacing import evenly_spaced

# Points solve their equation to rounding; Newton's method ends below this.
ROUNDING = 1e-12


def solved(function):
    """What gives the points of the curve function(u, number) = 0, for a number."""

    def linearized(u, number):
        return function(u, number), jax.jacfwd(function)(u, number)

    return lambda number=0.0: functools.partial(corrected, linearized, jnp.asarray(number))


@solved
def circle(u, radius):
    return jnp.array([u[0] ** 2 + u[1] ** 2 - radius**2])


@solved
def cubic(u, _):
    # Two folds: u[1] = x^3 - x turns round at x = -1/sqrt(3) and 1/sqrt(3).
    return jnp.array([u[0] ** 3 - u[0] - u[1]])


@solved
def imperfect_pitchfork(u, offset):
    return jnp.array([offset + u[1] * u[0] - u[0] ** 3])


def test_a_circle_is_followed_round():
    step, n = 0.3, 50
    points = list(continue_curve(circle(2.0), (1.9, 0.1), (0.0, 1.0), max_step=step, max_points=n))
    u = np.array([point.u for point in points])
    assert np.allclose(np.hypot(*u.T), 2.0, rtol=0, atol=ROUNDING)
    assert [point.end for point in points] == [None] * (n - 1) + [Stop.POINT_COUNT]
    # Past where it began: the angle grows from one point to the next.
    angle = np.unwrap(np.arctan2(u[:, 1], u[:, 0]))
    assert np.all(np.diff(angle) > 0) and angle[-1] - angle[0] > 2 * np.pi
    # A step is along the tangent: the chord is longer by (step/radius)^2/2 of it at most.
    chords = np.hypot(*np.diff(u, axis=0).T)
    assert np.all(chords < step * (1 + 0.5 * (step / 2) ** 2))


def test_folds_are_passed_and_the_span_is_met_exactly():
    points = list(continue_curve(cubic(), (-1.5, -1.9), (1.0, 0.0), span=((-2, -3), (2, 2.5))))
    u = np.array([point.u for point in points])
    assert np.allclose(u[:, 0] ** 3 - u[:, 0], u[:, 1], rtol=0, atol=ROUNDING)
    assert np.sum(np.diff(np.sign(np.diff(u[:, 1]))) != 0) == 2
    assert points[-1].end is Stop.LEFT_SPAN and u[-1, 1] == pytest.approx(2.5, abs=ROUNDING)
    # The tangent has unit length, goes the way of the motion, and is vertical at the folds only.
    tangents = np.array([point.tangent for point in points])
    assert np.allclose(np.linalg.norm(tangents, axis=1), 1.0, rtol=0, atol=1e-14)
    assert np.all(np.sum(tangents[:-1] * np.diff(u, axis=0), axis=1) > 0)
    assert points[0].end is None


@pytest.mark.parametrize("side", [0.5, 0.5 + 1e-14])
def test_a_point_on_a_side_of_the_span_is_told_once(side):
    """Steps of a quarter come to it by themselves, up to rounding."""
    line, ahead = solved(lambda u, _: u[:1])(), np.array([0.0, 1.0])
    span, steps = (-1.0, side), {"step": 0.25, "max_step": 0.25}
    points = list(continue_curve(line, np.zeros(2), ahead, span=span, **steps))
    assert [float(point.u[1]) for point in points] == pytest.approx([0.0, 0.25, 0.5], abs=1e-13)
    assert [point.end for point in points] == [None, None, Stop.LEFT_SPAN]
    for start in (side, np.nextafter(side, 1.0)):
        (only,) = continue_curve(line, start * ahead, ahead, span=span, **steps)
        assert only.end is Stop.LEFT_SPAN and only.u[1] == pytest.approx(side, abs=1e-15)


def test_a_pitchfork_off_its_axis_is_followed_round_the_bend():
    branch = continue_curve(imperfect_pitchfork(-1e-4), (-0.7, 0.49), (0.0, -1.0), span=(-1, 1))
    u = np.array([point.u for point in branch])
    # With the offset the branch comes down one side and leaves along the axis, x = offset / -p.
    assert u[-1] == pytest.approx([-1e-4, -1.0], abs=1e-7)
    # It never passes to the other side.
    assert np.all(u[:, 0] < 0)
    # Against the sense: up to the edge, the outer branch sqrt(p).
    *_, last = continue_curve(imperfect_pitchfork(-1e-4), (-0.7, 0.49), (0.0, 1.0), span=(-1, 1))
    assert last.u[1] == pytest.approx(1.0, abs=ROUNDING) and last.end is Stop.LEFT_SPAN


def test_ends():
    *_, last = continue_curve(circle(2.0), (2.0, 0.0), (0.0, 1.0), max_points=7)
    assert last.end is Stop.POINT_COUNT

    @solved
    def until_it_stops(u, _):
        return jnp.array([u[1] - jnp.sqrt(1 - u[0])])

    *_, last = continue_curve(until_it_stops(), (0.0, 1.0), (1.0, 0.0))
    # The square root's branch point ends the real curve.
    assert last.end is Stop.STEP_TOO_SMALL and last.u == pytest.approx([1, 0], abs=1e-3)

    assert list(continue_curve(until_it_stops(), (3.0, 1.0), (1.0, 0.0))) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": (np.nan, 0.0)}, "start must be finite"),
        ({"direction": (0.0, 0.0)}, "direction must be not zero"),
        ({"direction": (0.0, 1.0, 0.0)}, "direction must be of shape"),
        ({"step": 1.0}, "step must be such that 0 < min_step <= step <= max_step"),
    ],
)
def test_impossible_arguments_are_named(arguments, message):
    given = {"start": (2.0, 0.0), "direction": (0.0, 1.0), **arguments}
    with pytest.raises(ValueError, match=message):
        list(continue_curve(circle(2.0), given.pop("start"), given.pop("direction"), **given))


# --- even values of a parameter -------------------------------------------------------------------


@pytest.mark.parametrize("n", [3, 5, 61, 101, 141, 1001])
@pytest.mark.parametrize("ends", [(-0.7, 0.7), (-1.1, 1.1), (-1 / 3, 1 / 3)])
def test_the_middle_of_a_symmetric_span_is_zero(ends, n):
    values = evenly_spaced(*ends, n)
    assert values[n // 2] == 0 and np.array_equal(values, -values[::-1])


@pytest.mark.parametrize("n", [1, 2, 7, 100])
def test_it_is_as_even_as_numpy(n):
    values = evenly_spaced(0.1, 2.3, n)
    np.testing.assert_allclose(values, np.linspace(0.1, 2.3, n), rtol=4e-16)
    assert values[0] == 0.1 and values[-1] == (2.3 if n > 1 else 0.1)
