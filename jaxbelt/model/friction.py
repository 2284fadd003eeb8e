"""Friction laws: the coefficient of friction as a function of the sliding speed.

A law has two parts: `static`, the coefficient that holds a stuck mass, and `mu(speed)`, the
coefficient while it slips. A slip mode keeps the sign of its relative velocity (see `modes`), so an
integrator or a Newton iteration may ask for a speed slightly below zero; each law therefore
continues smoothly a little beyond its boundary. A user's law is a subclass of `AbstractFriction`
with these two. The laws of this module are not checked as users' laws are: they are known to be
smooth and traceable.
"""

import abc
import itertools
import operator
import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..checks import (
    Parameters,
    Rule,
    as_array,
    as_numbers,
    be_finite,
    be_nonnegative,
    be_positive,
    check_nonnegative,
    is_concrete,
    number,
    require,
    require_one_float,
    require_value,
    scalar,
    traceable,
)

#: Allowed rounding of mu(0), relative to 1 + static.
MU_ROUNDING = 1e-14


class AbstractFriction(Parameters):
    """A friction law: subclass it with `static` and `mu` to define your own.

    Attributes:
        static: Coefficient mus that holds a stuck mass, a dimensionless scalar.
    """

    static: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def mu(self, speed: Array) -> Array:
        """Kinetic friction coefficient mu.

        It must be smooth for speed >= 0 and stay finite and smooth slightly below 0; 0 <= mu(0) <=
        static, and the latter two are equal for a law without a jump.

        Args:
            speed: Sliding speed `|nu_R|`, dimensionless, any shape.

        Returns:
            The coefficient, of the same shape.
        """

    def fraction(self, speed: Array) -> tuple[Array, Array]:
        """mu(speed) as (numerator, denominator > 0), so that kernels divide once, at the end."""
        return self.mu(speed), jnp.ones_like(speed)

    @property
    def measured_to(self) -> ArrayLike:
        """Speed beyond which the law is an extrapolation; inf if there is none."""
        return np.inf

    def in_units_of(self, speed: Array) -> "AbstractFriction":
        """The same law for speeds that are given in units of `speed`; see `Machine`."""
        return LawInUnits(self, speed)

    def rules(self) -> list[Rule]:
        """Conditions on its parameters; a user's law may add to them."""
        return _of_static(self.static, self.mu(jnp.zeros(jnp.shape(self.static))))


def friction_jumps(law: AbstractFriction) -> Array:
    """Whether the static coefficient of a law exceeds mu(0) by more than rounding."""
    static = jnp.asarray(law.static)
    return static - law.mu(jnp.zeros(())) > MU_ROUNDING * (1 + static)


def _of_static(static: ArrayLike, begins: ArrayLike) -> list[Rule]:
    """Rules of a law with this static coefficient and mu(0) = begins."""
    most = static + MU_ROUNDING * (1 + static)
    bound = Rule("mu(0)", (begins, static, most), _is_at_most, "<= static = {1}")
    # A negative coefficient pushes: such a belt would hold the mass and release it at once.
    least = Rule("mu(0)", (begins, -MU_ROUNDING), operator.ge, ">= 0")
    return [*be_nonnegative("static", static), least, bound]


def _is_at_most(value: Any, _: Any, most: Any) -> Any:
    return value <= most


#: Classes of users' laws whose `mu` was traced, each with its fields that were None; and classes
#: that were searched for kinks.
_traced: set[tuple[Any, ...]] = set()
_asked_of_kinks: set[type] = set()


def check_law(law: AbstractFriction) -> None:
    """Raises a `ValueError` if a user's law cannot be used.

    A law cannot be used if a field is neither a number nor static, or if `mu` cannot be traced,
    which is tried once for each class and set of fields that are None. (A law that calls NumPy's
    exponential gives right numbers by itself and fails inside compiled programs.)
    """
    kind = type(law)
    if kind.__module__ == __name__:
        return
    absent = []
    for path, leaf in jax.tree.leaves_with_path(law, is_leaf=lambda leaf: leaf is None):
        name = jax.tree_util.keystr(path).lstrip(".")
        if leaf is None and name != "static":
            absent.append(name)
            continue
        expected = "a number or an array, or declared as equinox.field(static=True)"
        is_number = isinstance(leaf, jax.Array | np.ndarray | np.generic | float | int)
        require_value(is_number, f"{name} of {kind.__name__}", expected, leaf)
    if (kind, *absent) in _traced:
        return
    speed = jax.ShapeDtypeStruct((), jnp.float64)

    def coefficients() -> Any:
        return jax.eval_shape(law.mu, speed)

    where = f" where {' and '.join(absent)} is None" if absent else ""
    found = traceable(coefficients, f"mu of {kind.__name__}", f"a function of the speed{where}")
    expected = "a function that returns one float64 a speed"
    require_one_float(found, f"mu of {kind.__name__}", expected)
    _traced.add((kind, *absent))


def _warn_of_kink(law: AbstractFriction) -> None:
    """Warns if a known law of the user has a jump or a kink, once for each class."""
    kind = type(law)
    if kind in _asked_of_kinks or kind.__module__ == __name__ or not is_concrete(law):
        return
    _asked_of_kinks.add(kind)
    jump, kink = jump_and_kink(law)
    if jump is not None:
        message = (
            "mu of {} jumps at the speed {:.6g}, from {:.3g} to {:.3g}: motions that pass that "
            "speed are off by far more than the tolerance, and most of their cycles are not found "
            "(NO_CONVERGENCE). Let it change over a small range of speeds instead."
        )
        warnings.warn(message.format(kind.__name__, *jump), stacklevel=2)
    elif kink is not None:
        message = (
            "mu of {} has a kink at the speed {:.6g}, its slope goes from {:.3g} to {:.3g}: "
            "motions that slip at that speed are followed, but most of their cycles are not "
            "found (NO_CONVERGENCE). Of a table jb.Tabulated(speeds, coefficients) makes a "
            "smooth law."
        )
        warnings.warn(message.format(kind.__name__, *kink), stacklevel=2)


#: Speeds between which jumps and kinks are searched, and how often their intervals are halved.
SEARCHED, HALVINGS = np.logspace(-5, 3, 2049), 30
#: Changes below these are rounding: of the slope, LEAST_KINK of itself or LEAST_BEND of mu / speed;
#: of mu, LEAST_JUMP of itself.
LEAST_KINK, LEAST_BEND, LEAST_JUMP = 1e-3, 1e-6, 1e-6


#: A speed, and the values just below and just above it.
Change = tuple[float, float, float]


def jump_and_kink(law: AbstractFriction) -> tuple[Change | None, Change | None]:
    """The largest jump of mu of a law with known numbers, and the largest jump of its slope; None
    where there is none."""
    own = law.law if isinstance(law, LawInUnits) else law
    if type(own).__module__ == __name__:
        return None, None  # these are smooth

    @jax.jit
    def asked(speeds: Array) -> Array:
        """mu at the first row of speeds, its slope at the second."""
        values, slopes = jax.vmap(lambda speed: jax.jvp(law.mu, (speed,), (jnp.ones(()),)))(
            speeds.reshape(-1)
        )
        half = speeds.shape[1]
        return jnp.stack([values[:half], slopes[half:]])

    # Every interval is halved again and again, and the half with the larger change is kept: without
    # a jump the change becomes less and less.
    with jax.ensure_compile_time_eval():
        speeds = np.stack([SEARCHED, SEARCHED])
        found = np.asarray(asked(jnp.asarray(speeds)))
        (low, high), (before, after) = ((x[:, :-1], x[:, 1:]) for x in (speeds, found))
        mu = after[0]
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            # Filled up to the length of `speeds`, so that nothing is compiled again.
            filled = np.append(middle, np.ones((2, 1)), axis=1)
            between = np.asarray(asked(jnp.asarray(filled)))[:, :-1]
            left = np.abs(between - before) > np.abs(after - between)
            low, high = np.where(left, low, middle), np.where(left, middle, high)
            before, after = np.where(left, before, between), np.where(left, between, after)
    least = np.array([[LEAST_JUMP], [LEAST_KINK]]) * np.maximum(np.abs(before), np.abs(after))
    least[1] = np.maximum(least[1], LEAST_BEND * np.abs(mu) / high[1])
    jump, kink = map(_largest, high, before, after, least)
    return jump, kink


def _largest(
    at: np.ndarray, before: np.ndarray, after: np.ndarray, least: np.ndarray
) -> Change | None:
    """The largest of the changes above `least`: its speed, and the values on both sides; None if
    there is none."""
    changes = np.abs(after - before)
    found = np.flatnonzero(changes > least)
    if not len(found):
        return None
    most = found[np.argmax(changes[found])]
    return float(at[most]), float(before[most]), float(after[most])


def as_friction(law: Any) -> AbstractFriction:
    """The law itself, or a `ValueError` if it is no friction law."""
    fits = isinstance(law, AbstractFriction)
    require_value(fits, "friction", "a law such as jb.Conti(...)", law)
    check_law(law)
    _warn_of_kink(law)
    return law


class LawInUnits(AbstractFriction):
    """A law that takes its speeds in another unit: mu(r) is law.mu(unit r)."""

    law: AbstractFriction
    unit: Array

    def __init__(self, law: AbstractFriction, unit: Array):
        self.law, self.unit = law, unit

    # A property: a copy would be a further leaf, that is, a further parameter.
    @property
    def static(self) -> ArrayLike:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.law.static

    @property
    def measured_to(self) -> ArrayLike:
        return self.law.measured_to / self.unit

    def fraction(self, speed: Array) -> tuple[Array, Array]:
        return self.law.fraction(self.unit * speed)

    def mu(self, speed: Array) -> Array:
        """Kinetic friction coefficient of the law at unit times the speed, any shape."""
        return self.law.mu(self.unit * speed)

    def in_units_of(self, speed: Array) -> AbstractFriction:
        unit = self.unit * speed
        # A law that is converted there and back is the law itself, up to rounding.
        is_own = is_concrete(unit) and np.all(np.abs(np.asarray(unit) - 1.0) < 1e-15)
        return self.law if is_own else LawInUnits(self.law, unit)

    def rules(self) -> list[Rule]:
        return type(self.law).rules(self.law)


class Conti(AbstractFriction):
    """Conti's law: mu falls hyperbolically with the speed.

    Eqs. (7) and (16) of the paper: mu(r) = (mus - p1) / (1 + p3 r) + p1 + p2 r^2, so mu(0) = mus.
    All arguments are dimensionless scalars.

    Args:
        static: mus >= 0.
        residual: p1 >= 0.
        steepness: p3 >= 0.
        quadratic: p2, default 0.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """

    static: Float[Array, ""] = eqx.field(converter=scalar("static"))
    residual: Float[Array, ""] = eqx.field(converter=scalar("residual"))
    steepness: Float[Array, ""] = eqx.field(converter=scalar("steepness"))
    quadratic: Float[Array, ""] = eqx.field(converter=scalar("quadratic"), default=0.0)

    def __check_init__(self):
        self.check("Conti")

    def rules(self) -> list[Rule]:
        rules = be_finite("quadratic", self.quadratic)
        for name in ("static", "residual", "steepness"):
            rules += be_nonnegative(name, getattr(self, name))
        return rules

    def in_units_of(self, speed: Array) -> AbstractFriction:
        steepness, quadratic = self.steepness * speed, self.quadratic * speed**2
        return Conti(self.static, self.residual, steepness, quadratic)

    def fraction(self, speed: Array) -> tuple[Array, Array]:
        mus, p1, p2, p3 = self.static, self.residual, self.quadratic, self.steepness
        # The formula has a pole at r = -1/p3, close below the boundary; half way there it is cut
        # off, so that a trial step beyond the boundary meets large errors but never infinity.
        denominator = 1 + jnp.maximum(p3 * speed, -0.5)
        return (mus - p1) + (p1 + p2 * speed**2) * denominator, denominator

    def mu(self, speed: Array) -> Array:
        """Kinetic friction coefficient mu(r), eq. (7) of the paper.

        Args:
            speed: Sliding speed r = `|nu_R| = |nu - omega x2|` >= 0, dimensionless, any shape.

        Returns:
            The coefficient, of the same shape.
        """
        numerator, denominator = self.fraction(speed)
        return numerator / denominator


class Coulomb(AbstractFriction):
    """Coulomb's law with separate static and kinetic coefficients: mu(r) = kinetic for r > 0.

    Args:
        static: Static coefficient, a dimensionless scalar.
        kinetic: Kinetic coefficient, likewise; static >= kinetic >= 0.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """

    static: Float[Array, ""] = eqx.field(converter=scalar("static"))
    kinetic: Float[Array, ""] = eqx.field(converter=scalar("kinetic"))

    def __check_init__(self):
        self.check("Coulomb")

    def rules(self) -> list[Rule]:
        return _of_static_and_kinetic(self.static, self.kinetic)

    def in_units_of(self, speed: Array) -> AbstractFriction:
        return self

    def mu(self, speed: Array) -> Array:
        """Kinetic friction coefficient, the same at every speed (any shape)."""
        return jnp.broadcast_to(self.kinetic, jnp.shape(speed))


class Stribeck(AbstractFriction):
    """Stribeck's law with exponential decay: mu(r) = kinetic + (static - kinetic) exp(-r/velocity).

    Used in this form by L. C. Bo and D. Pavelescu, The friction-speed relation and its influence on
    the critical velocity of stick-slip motion, Wear 82 (1982) 277-289.

    Args:
        static: Static coefficient, a dimensionless scalar.
        kinetic: Kinetic coefficient at high speeds, likewise; static >= kinetic >= 0.
        velocity: Stribeck velocity > 0, likewise.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """

    static: Float[Array, ""] = eqx.field(converter=scalar("static"))
    kinetic: Float[Array, ""] = eqx.field(converter=scalar("kinetic"))
    velocity: Float[Array, ""] = eqx.field(converter=scalar("velocity"))

    def __check_init__(self):
        self.check("Stribeck")

    def rules(self) -> list[Rule]:
        both = _of_static_and_kinetic(self.static, self.kinetic)
        return both + be_positive("velocity", self.velocity)

    def in_units_of(self, speed: Array) -> AbstractFriction:
        return Stribeck(self.static, self.kinetic, self.velocity / speed)

    def mu(self, speed: Array) -> Array:
        """Kinetic friction coefficient mu(r) at speed r >= 0, dimensionless, any shape."""
        # Cut off below the boundary like Conti's law: an exponential overflows there.
        decay = jnp.exp(-jnp.maximum(speed / self.velocity, -1.0))
        return self.kinetic + (self.static - self.kinetic) * decay


class Cubic(AbstractFriction):
    """A cubic law: mu(r) = a0 - a1 r + a3 r^3, so mu(0) = a0, the static coefficient.

    Used by M. di Bernardo, P. Kowalczyk and A. Nordmark, Sliding bifurcations: a novel mechanism
    for the sudden onset of chaos in dry friction oscillators, Int. J. Bifurcation Chaos 13 (2003)
    2935-2948, with a0 = a1 = 1.5 and a3 = 0.45.

    Args:
        a0: Static coefficient >= 0, a dimensionless scalar.
        a1: Initial decrease, mu'(0) = -a1, likewise.
        a3: Cubic coefficient, likewise.

    Raises:
        ValueError: If an argument is impossible; the message names it.
    """

    a0: Float[Array, ""] = eqx.field(converter=scalar("a0"))
    a1: Float[Array, ""] = eqx.field(converter=scalar("a1"))
    a3: Float[Array, ""] = eqx.field(converter=scalar("a3"))

    def __init__(self, a0: ArrayLike, a1: ArrayLike, a3: ArrayLike):
        self.a0, self.a1, self.a3 = a0, a1, a3  # pyright: ignore[reportAttributeAccessIssue]

    def __check_init__(self):
        self.check("Cubic")

    # A property: a copy would be a further leaf, that is, a further parameter.
    @property
    def static(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.a0

    def rules(self) -> list[Rule]:
        return be_nonnegative("a0", self.a0) + be_finite("a1", self.a1) + be_finite("a3", self.a3)

    def in_units_of(self, speed: Array) -> AbstractFriction:
        return Cubic(self.a0, self.a1 * speed, self.a3 * speed**3)

    def mu(self, speed: Array) -> Array:
        """Kinetic friction coefficient mu(r) at speed r >= 0, dimensionless, any shape."""
        return self.a0 + speed * (self.a3 * speed**2 - self.a1)


def _of_static_and_kinetic(static: ArrayLike, kinetic: ArrayLike) -> list[Rule]:
    rules = be_nonnegative("static", static) + be_nonnegative("kinetic", kinetic)
    return [*rules, Rule("kinetic", (kinetic, static), operator.le, "<= static = {1}")]


#: How far the curve of a table may leave the range of the points beside, over the largest
#: coefficient. For laws that fall and level out at most 0.028 was seen, hardly visible in a plot.
MOST_ASTRAY = 0.03


class Tabulated(AbstractFriction):
    """A law from a table of measured coefficients: a smooth curve through all of its points.

    mu(r) = level + sum of w_i sqrt((r - r_i)^2 + h_i^2) over the points (r_i, mu_i), Hardy's
    multiquadrics: h_i is the distance of r_i from the nearer of its neighbours, and the w_i, whose
    sum is zero, are such that mu(r_i) = mu_i. The curve has all derivatives, keeps close to
    straight lines between the points, and levels out beyond the last one; a warning says where it
    does not. Motions that slip faster than the last point depend on the curve beyond it: in a
    stick-slip cycle speeds reach about twice the belt's velocity. The curve follows scatter, too:
    smooth such tables first. See R. L. Hardy, Multiquadric equations of topography and other
    irregular surfaces, J. Geophys. Res. 76 (1971) 1905-1915.

    The numbers of the table are static, not parameters, so another table compiles anew.

    Args:
        speeds: Speeds r_i, increasing, >= 0, two or more.
        coefficients: Coefficients mu_i >= 0, as many.
        static: Static coefficient, a scalar; None: mu(0) of the curve.

    Raises:
        ValueError: If an argument is impossible, or static is less than mu(0).
    """

    static: Float[Array, ""]
    speeds: tuple[float, ...] = eqx.field(static=True)
    coefficients: tuple[float, ...] = eqx.field(static=True)
    weights: tuple[float, ...] = eqx.field(static=True)
    level: float = eqx.field(static=True)

    def __init__(
        self,
        speeds: ArrayLike | Sequence[float],
        coefficients: ArrayLike | Sequence[float],
        static: ArrayLike | None = None,
    ):
        speeds, coefficients = _table(speeds, coefficients)
        self.speeds, self.coefficients = tuple(speeds.tolist()), tuple(coefficients.tolist())
        basis, one = _multiquadrics(np, speeds, speeds), np.ones((len(speeds), 1))
        matrix = np.block([[basis, one], [one.T, np.zeros((1, 1))]])
        *weights, _ = np.linalg.solve(matrix, np.append(coefficients, 0.0)).tolist()
        self.weights = tuple(weights)
        # Makes the curve exact at the first point, mostly speed 0, the static coefficient.
        self.level = float(coefficients[0] - np.sum(weights * basis[0]))
        off = np.max(np.abs(basis @ weights + self.level - coefficients))
        fits = off <= 1e-9 * np.max(coefficients)
        require(fits, "speeds", "far enough apart for a curve through all points", speeds)
        self.static = as_array(self._begins if static is None else static, "static")

    def __check_init__(self):
        self.check("Tabulated")
        self._warn_if_astray()

    def _warn_if_astray(self) -> None:
        """Warns if the curve leaves the range of its points, as where gaps of the table differ
        much."""
        speeds, mus = np.array(self.speeds), np.array(self.coefficients)
        # Beyond the last point mu may change as much as over the last gap, but must not push.
        beyond = max(0.0, 2.0 * mus[-1] - mus[-2])
        ends, steps = np.append(speeds, 3.0 * speeds[-1]), np.append(mus, beyond)
        at = np.concatenate([np.linspace(*gap, 65) for gap in itertools.pairwise(ends)])
        around = np.repeat(np.sort([steps[:-1], steps[1:]], axis=0), 65, axis=1)
        curve = self._known(at)
        off = np.maximum(around[0] - curve, curve - around[1])
        worst = np.argmax(off)
        if off[worst] > MOST_ASTRAY * np.max(mus):
            warnings.warn(
                "the curve through the table goes to mu = {:.3g} at the speed {:.3g}, where one "
                "expects {:.3g} to {:.3g}: more points there hold it".format(
                    curve[worst], at[worst], *around[:, worst]
                ),
                stacklevel=5,
            )

    def mu(self, speed: Array) -> Array:
        """Kinetic friction coefficient mu(r) at speed r >= 0 (the table's unit), any shape."""
        terms = _multiquadrics(jnp, jnp.asarray(speed), np.array(self.speeds))
        weights = np.reshape(self.weights, (1,) * jnp.ndim(speed) + (-1,))
        return self.level + jnp.sum(weights * terms, axis=-1)

    @property
    def measured_to(self) -> ArrayLike:
        return self.speeds[-1]

    def _known(self, speed: Any) -> Any:
        """`mu` in NumPy, which compiles nothing."""
        terms = _multiquadrics(np, np.asarray(speed), np.array(self.speeds))
        return self.level + np.sum(np.asarray(self.weights) * terms, axis=-1)

    @property
    def _begins(self) -> float:
        return float(self._known(0.0))

    def rules(self) -> list[Rule]:
        known = is_concrete(self.static)
        return _of_static(np.asarray(self.static) if known else self.static, self._begins)

    def __repr__(self) -> str:
        # The whole table, because stores of results are identified by this text.
        columns = (", ".join(map("{:.12g}".format, c)) for c in (self.speeds, self.coefficients))
        return "Tabulated([{}], [{}], static={})".format(*columns, number(self.static))


def _table(speeds: Any, coefficients: Any) -> tuple[np.ndarray, np.ndarray]:
    """The two columns of a table, or a `ValueError`."""
    known = is_concrete((speeds, coefficients))
    require(known, "speeds", "known, as coefficients: they are no parameters", "traced ones")
    columns = []
    for name, column in (("speeds", speeds), ("coefficients", coefficients)):
        length = (len(columns[0]),) if columns else (None,)
        columns.append(np.asarray(as_numbers(column, name, length)))
        check_nonnegative(columns[-1], name)
    require(len(columns[0]) >= 2, "speeds", "two or more", len(columns[0]))
    require_value(np.all(np.diff(columns[0]) > 0), "speeds", "increasing", columns[0])
    return columns[0], columns[1]


def _multiquadrics(numpy: Any, at: Any, speeds: np.ndarray) -> Any:
    """sqrt((at - r_i)^2 + h_i^2) for every point of a table, along a further last axis."""
    gaps = np.pad(np.diff(speeds), 1, constant_values=np.inf)
    widths = np.minimum(gaps[:-1], gaps[1:])
    shape = (1,) * numpy.ndim(at) + (-1,)
    away = numpy.expand_dims(at, -1) - speeds.reshape(shape)
    return numpy.sqrt(away**2 + widths.reshape(shape) ** 2)
