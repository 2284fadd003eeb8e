"""Winding numbers of forced runs: how many maxima of x1 there are in a period of the forcing.

Where a map of the circle that preserves order takes the phase of each maximum to that of the next
one, the k-th maximum comes D periods after the first with floor(D)/k <= r <= ceil(D)/k, r
the mean number of periods between maxima. All these bounds together leave an interval whose ends
are the neighbours of r among the fractions with denominators up to the number of maxima: between
them there is no fraction with a smaller denominator than theirs. Bounds that contradict each other
show that the order is not kept, as in chaos.

A. Katok, B. Hasselblatt, Introduction to the Modern Theory of Dynamical Systems, 1995, sec. 11.1.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..kernel.lanes import Lanes, materialise
from ..numerics.implicit import step_to_root
from .moments import Course

#: A number of periods between maxima is whole up to this, the error of the times of maxima.
WHOLE = 1e-7
#: Least number of maxima by which order is judged; a motion counts as ordered if it repeats, at the
#: earliest, after one PARTS_OF_MAXIMA-th of its maxima, or never.
FEWEST_MAXIMA, PARTS_OF_MAXIMA = 256, 16
#: Where a step lands on a bound of its mode, the sign of a smaller |x2| is rounding: the mass may
#: come to rest there.
LANDED = 1e-9
#: Number of Newton steps for the time of a maximum within a step.
STEPS_TO_MAXIMUM = 3


class Winding(eqx.Module):
    """The maxima of x1 of a run, and the bounds of the periods between them, arrays [lanes].

    rises: whether x2 was positive when it last was not zero; maxima: number of maxima; began,
    first: the time of the maximum from which bounds are counted, NaN before it, and its number;
    latest: periods from it to the latest maximum; low, high: bounds of the mean number of periods
    between two maxima; low_after, high_after: number of maxima after which each bound was first
    known, which is its denominator.
    """

    rises: Array
    maxima: Array
    began: Array
    first: Array
    latest: Array
    low: Array
    high: Array
    low_after: Array
    high_after: Array

    @classmethod
    def none(cls, lanes: Lanes) -> "Winding":
        zero, count = jnp.zeros_like(lanes.t), jnp.zeros_like(lanes.events)
        nan, inf = zero + jnp.nan, zero + jnp.inf
        return cls(lanes.x2 > 0, count, nan, count, zero, zero, inf, count, count)

    def followed(
        self, lanes: Lanes, new: Lanes, course: Course, first_at: Array, period: Array, ones: Array
    ) -> "Winding":
        """The winding after a step; bounds count from the first maximum at `first_at` or later.

        Where the mass rests between its rise and its fall, the maximum is where it begins to fall.
        """
        rests = (new.x2 == 0) | ((new.h < 0) & (jnp.abs(new.x2) < LANDED))
        here = self.rises & (new.x2 < 0) & ~rests
        maxima = self.maxima + here.astype(self.maxima.dtype)
        fall = lanes.x2 - new.x2
        theta = jnp.where(fall > 0, lanes.x2 / jnp.where(fall > 0, fall, 1.0), 1.0)
        for _ in range(STEPS_TO_MAXIMUM):
            theta = jnp.clip(theta + step_to_root(*course.velocity(theta)), 0.0, 1.0)
        t = materialise(lanes.t + theta * course.duration, ones)
        starts = here & jnp.isnan(self.began) & (t >= first_at)
        counts = here & ~jnp.isnan(self.began)
        k = maxima - self.first
        safe = jnp.where(counts, k, 1).astype(t.dtype)
        periods = jnp.where(counts, (t - self.began) / period, 0.0)
        low, high = jnp.floor(periods + WHOLE) / safe, jnp.ceil(periods - WHOLE) / safe
        above, below = counts & (low > self.low), counts & (high < self.high)
        return Winding(
            rises=jnp.where(rests, self.rises, new.x2 > 0),
            maxima=maxima,
            began=jnp.where(starts, t, self.began),
            first=jnp.where(starts, maxima, self.first),
            latest=jnp.where(counts, periods, self.latest),
            low=jnp.where(above, low, self.low),
            high=jnp.where(below, high, self.high),
            low_after=jnp.where(above, k, self.low_after),
            high_after=jnp.where(below, k, self.high_after),
        )

    @property
    def rises_begun(self) -> Array:
        """How often x1 has begun to rise: a fixed number of times in each period of a motion, even
        where rounding decides whether a maximum at a strobe is before or behind it."""
        return self.maxima + self.rises.astype(self.maxima.dtype)

    @property
    def is_ordered(self) -> Array:
        """Whether maxima keep their order, and repeat only after many of them or never."""
        count = self.maxima - self.first
        repeats_after = jnp.minimum(self.low_after, self.high_after)
        return (
            (count >= FEWEST_MAXIMA)
            & (self.low <= self.high)
            & (repeats_after * PARTS_OF_MAXIMA >= count)
        )

    def number(self, ordered: Array) -> Array:
        """Maxima per period: from the bounds where `ordered`, else from the periods measured."""
        count = (self.maxima - self.first).astype(self.low.dtype)
        between = 0.5 * (self.low + self.high) * count
        periods = jnp.where(ordered, between, self.latest)
        return jnp.where(periods > 0, count / jnp.where(periods > 0, periods, 1.0), jnp.nan)
