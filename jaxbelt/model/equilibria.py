"""Fixed points, segments of pseudo-equilibria, pseudo-foci, two-fold saddles; all at x2 = 0.

The contact edges cut the x1 axis into zones. At rest within a zone every touching belt that moves
pulls with u0_i mu_i(|nu_i|) sgn(nu_i), and the spring balances their sum, the pull, at x1 = pull.
That is a fixed point, eq. (24) of the paper, if it lies in the zone. Touching belts at rest hold
any force up to their capacity, the sum of u0_k mus_k: then all x1 no farther than the capacity
from the pull are pseudo-equilibria, a segment. At an edge between two zones whose accelerations
both point to the edge, a_L > 0 > a_R, there is a pseudo-focus (see `pseudofocus.edge_focus`).

At an edge from which both sides push the mass away, a_L < 0 < a_R, there is a saddle: x1' = x2 on
both sides, so nothing slides along an edge, and (sigma, 0) is a visible-visible two-fold (see M.
Guardia, T. M. Seara and M. A. Teixeira, Generic bifurcations of low codimension of planar Filippov
systems, J. Differential Equations 250 (2011) 1967-2023). Four orbits reach and leave it in a finite
time. No mass rests there: code that asks where it can rest calls `candidates`, without saddles.

Everything is in closed form, so derivatives with respect to any parameter go through.
"""

import enum
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..activity import announced
from ..checks import is_concrete, number, pick
from ..numerics.compiling import jit
from ..results import draw
from ..tables import per_belt, require_single, table_of
from .modes import (
    STUCK,
    Mode,
    capacity,
    edges,
    force_rounding,
    kinetic_capacity,
    mode_acceleration,
    settle,
    zone_ends,
)
from .oscillator import Oscillator, check_oscillator, has_possible_numbers, refuse_clock
from .own_units import in_given_units, in_own_units, quantity
from .pseudofocus import derivatives_at_rest, edge_focus
from .rest import is_centre
from .transitions import contact, contact_beside

if TYPE_CHECKING:
    import pandas


class EquilibriumKind(enum.IntEnum):
    """Kind of an equilibrium."""

    FIXED_POINT = 1  #: rest in a smooth field
    SEGMENT = 2  #: a segment of states of rest, held by belts at rest
    PSEUDO_FOCUS = 3  #: on a contact edge, each side of which pushes the mass to the other side
    SADDLE = 4  #: on a contact edge, both sides of which push the mass away; nothing rests there


class Equilibria(eqx.Module):
    """The equilibria (x1, 0) from left to right; what `equilibria` returns.

    Arrays have a row for each equilibrium; under a transformation they are padded to a common
    length (four for each belt, and one), outside cut to the existing rows. `equilibria(osc)[i]` is
    one row, and a loop runs over the rows.

    A segment is stable if small disturbances of some part of it stay small and end in it again. In
    that part the needed force is less than the sum of u0_k mu_k(0); the rest of a segment, if mu(0)
    is less than the static limit, holds but does not attract, unless an edge ends it beyond which
    the mass, having slipped away, is pushed back. A mass that slips away and comes back only after
    a large motion does not make a segment stable.

    Attributes:
        kind: An `EquilibriumKind`, [equilibria] (0 where padded).
        x1: Position, for a segment its middle, [equilibria] (NaN where padded, like all below).
        x1_lower: Lower end of a segment, else x1.
        x1_upper: Upper end of a segment, else x1.
        modes: Contact codes, [equilibria, belts] (+1/-1 slip with that sign of r_i, 0 stuck, -2/+2
            mass below/above the belt's interval; all 0 where padded). At a pseudo-focus and a
            saddle, the codes on the left-hand side of the edge.
        jacobian: Jacobian of the field of the mode at a fixed point, [equilibria, 2, 2], else NaN.
        eigenvalues: Eigenvalues of the Jacobian, eqs. (25) and (26) of the paper, the one with the
            larger real or imaginary part first, complex [equilibria, 2], else NaN.
        rate: Small disturbances behave like exp(rate t). The largest real part of the eigenvalues
            at a fixed point; at a pseudo-focus `(tr_L/a_L + tr_R/|a_R|) / (3 (1/a_L + 1/|a_R|))`,
            or -inf where a belt at rest touches, as disturbances then end in a finite time; inf at
            a saddle, which is left in a finite time; NaN for a segment.
        stable: Whether rate < 0, by more than rounding at fixed points; for segments see above.
        neutral: Whether it is a centre: orbits around it are closed, so it neither attracts nor
            repels. This holds where the forces on each side are the same at x2 and -x2, as without
            damping and with friction that does not depend on the speed.
    """

    kind: Array
    x1: Array = eqx.field(metadata=quantity("length"))
    x1_lower: Array = eqx.field(metadata=quantity("length"))
    x1_upper: Array = eqx.field(metadata=quantity("length"))
    modes: Array
    jacobian: Array
    eigenvalues: Array
    rate: Array
    stable: Array
    neutral: Array

    def __len__(self) -> int:
        return len(self.kind)

    def __getitem__(self, index) -> "Equilibria":
        return pick(self, index)

    def __iter__(self) -> Iterator["Equilibria"]:
        return (self[i] for i in range(len(self)))

    def table(self) -> "pandas.DataFrame":
        """Returns a row for each equilibrium, from left to right.

        Columns: kind (the name of an `EquilibriumKind`), stable, neutral, x1, x1_lower, x1_upper,
        rate, frequency (the imaginary part of the first eigenvalue, with which small disturbances
        rotate), and contact_0, contact_1, ..., the contact code of each belt.
        """
        require_single(self, self.kind, 0, 1)
        rows = jax.tree.map(np.asarray, self)
        if self.kind.ndim == 0:
            rows = jax.tree.map(lambda leaf: leaf[None], rows)
        here = np.asarray(rows.kind) > 0
        names = {
            "kind": [EquilibriumKind(int(kind)).name for kind in np.asarray(rows.kind)[here]],
            "stable": rows.stable,
            "neutral": rows.neutral,
            "x1": rows.x1,
            "x1_lower": rows.x1_lower,
            "x1_upper": rows.x1_upper,
            "rate": rows.rate,
            "frequency": np.abs(np.imag(rows.eigenvalues))[:, 0],
            **per_belt("contact", rows.modes),
        }
        return table_of({n: x if n == "kind" else np.asarray(x)[here] for n, x in names.items()})

    def plot(self, ax: Any = None) -> Any:
        """Draws the equilibria in the phase plane, on its line x2 = 0.

        Args:
            ax: Axes; None makes new ones.

        Returns:
            The axes.
        """
        return draw(self, ax)

    def __repr__(self) -> str:
        if not is_concrete(self) or self.kind.ndim > 1:
            return f"Equilibria(kind={self.kind.shape}, x1={self.x1.shape})"
        if self.kind.ndim == 1:
            return f"Equilibria({'; '.join(map(_row_text, self))})"
        return f"Equilibria({_row_text(self)})"


def _row_text(row: Equilibria) -> str:
    if row.kind == 0:
        return "none"
    kind = EquilibriumKind(int(row.kind))
    where = number(row.x1)
    if kind == EquilibriumKind.SEGMENT:
        where = f"{number(row.x1_lower)} to {number(row.x1_upper)}"
    return f"{stability(row)} {kind.name} at x1 = {where}"


def stability(row: Equilibria) -> str:
    """Word for the stability of one row."""
    return "stable" if row.stable else "neutral" if row.neutral else "unstable"


@announced("equilibria")
def equilibria(osc: Oscillator) -> Equilibria:
    """All equilibria of the oscillator, saddles among them, sorted by x1.

    Works under `jax.jit`, `jax.vmap` and derivatives; nothing raises there. A segment that reaches
    across a contact edge is given in pieces, one for each zone, each with its own contact codes. A
    fixed point that lies on an edge, up to rounding, is listed with the zone that it belongs to, of
    two with the left one, and its eigenvalues are those of that side alone; it is stable where
    these are and the other side does not push away from it.

    Args:
        osc: The oscillator, with any friction laws, any number of belts and any contact intervals.

    Returns:
        The `Equilibria`.

    Raises:
        ValueError: If a parameter is impossible; the message names it.
    """
    check_oscillator(osc)
    refuse_clock(osc, "equilibria", "jb.simulate")
    own = in_own_units(osc)
    found = _all_candidates(own)
    return in_given_units(_existing(found, found), osc, own)


def _existing(rows, found: Equilibria):
    """The rows without padding where values are concrete, that is, outside of transformations."""
    if not is_concrete((rows, found)):
        return rows
    return pick(rows, slice(int(np.sum(np.asarray(found.kind) > 0))))


def most_equilibria(osc: Oscillator) -> int:
    """Largest possible number of equilibria: one for each zone and each edge (known edges count if
    they are finite, and once if they are equal)."""
    places = edges(osc)
    if is_concrete(places):
        places = [place for place in set(map(float, places)) if np.isfinite(place)]
    return 2 * len(places) + 1


@jit
def candidates(osc: Oscillator) -> Equilibria:
    """States of rest, without saddles: one row for each zone and each edge, sorted.

    Rows without an equilibrium come last, as NaN.
    """
    return _rows_of(osc, with_saddles=False)


@jit
def _all_candidates(osc: Oscillator) -> Equilibria:
    """States of rest and saddles, in rows like those of `candidates`."""
    return _rows_of(osc, with_saddles=True)


def _rows_of(osc: Oscillator, *, with_saddles: bool) -> Equilibria:
    positions = jnp.sort(jnp.stack(edges(osc)))
    zones, points = _in_zones(osc), _at_edges(osc, positions, with_saddles=with_saddles)
    rows = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), zones, points)
    return rows[jnp.argsort(rows.x1)]


# --- within the zones: fixed points and segments ------------------------------------------------


def _in_zones(osc: Oscillator) -> Equilibria:
    lower, upper = zone_ends(osc)
    rest = jnp.zeros_like(lower)
    mode = contact(osc, lower, rest, rightward=True)
    held = capacity(osc, mode)
    # A belt at rest that can hold nothing, for lack of load or friction, slips (either sign does).
    mode = Mode(tuple(jnp.where((c == STUCK) & (held == 0), 1.0, c) for c in mode.codes))
    pull = mode_acceleration(osc, mode, rest, rest)

    possible = has_possible_numbers(osc) & (upper - lower > force_rounding(pull))
    _, up_from_below = _outside_of(osc, lower, rightward=False)
    held_above, up_from_above = _outside_of(osc, upper, rightward=True)
    down_from_above = -up_from_above

    rounding = edge_rounding(pull, 1.0 + held)
    is_fixed = possible & (held == 0) & (lower - rounding < pull) & (pull < upper + rounding)
    on_lower, on_upper = (jnp.abs(pull - edge) < rounding for edge in (lower, upper))
    # A fixed point on an edge, beyond which belts at rest hold the mass, is an end of their
    # segment; one that both sides share is listed with the left zone.
    is_fixed &= ~(on_lower & (up_from_below == 0)) & ~(on_upper & held_above)
    first, last = jnp.maximum(pull - held, lower), jnp.minimum(pull + held, upper)
    at_first, at_last = first - lower < rounding, upper - last < rounding
    # A segment of a single point, at an edge, counts if the other side pushes the mass back to it.
    is_point = at_last & (down_from_above > 0) | at_first & (up_from_below > 0)
    least = jnp.where(is_point, -rounding, rounding)
    is_segment = possible & (held > 0) & (last - first > least)
    first = jnp.where(is_segment, jnp.minimum(first, last), first)
    exists = is_fixed | is_segment

    jacobian = jax.vmap(lambda mode, x1: _field_jacobian(osc, mode, x1))(mode, pull)
    eigenvalues = _eigenvalues(jnp.where(is_fixed[:, None, None], jacobian, jnp.eye(2)[None]))
    rate = jnp.real(eigenvalues[:, 0])

    kinetic = kinetic_capacity(osc, mode)
    attracts = jnp.maximum(pull - kinetic, lower) < jnp.minimum(pull + kinetic, upper)
    # A segment attracts, too, if a mass that slips off over an edge is pushed back and stops there.
    attracts |= at_first & (up_from_below > 0)
    attracts |= at_last & (down_from_above > 0)

    # Where the trace is 0 but for rounding, its sign would depend on the unit of length.
    decays = rate < -force_rounding(0.0)
    # A fixed point on an edge is not stable where the other side pushes the mass away.
    stays = ~(on_lower & (up_from_below < 0)) & ~(on_upper & (down_from_above < 0))
    neutral = is_fixed & is_centre(osc, mode) & stays
    on_edge = lax.stop_gradient(jnp.clip(pull, lower, upper) - pull)
    x1 = jnp.where(is_segment, 0.5 * (first + last), pull + on_edge)
    kind = jnp.where(is_segment, EquilibriumKind.SEGMENT.value, EquilibriumKind.FIXED_POINT.value)
    return Equilibria(
        kind=jnp.where(exists, kind, 0),
        x1=jnp.where(exists, x1, jnp.nan),
        x1_lower=jnp.where(exists, jnp.where(is_segment, first, x1), jnp.nan),
        x1_upper=jnp.where(exists, jnp.where(is_segment, last, x1), jnp.nan),
        modes=_codes(mode, exists),
        jacobian=jnp.where(is_fixed[:, None, None], jacobian, jnp.nan),
        eigenvalues=jnp.where(is_fixed[:, None], eigenvalues, complex(np.nan, np.nan)),
        rate=jnp.where(is_fixed, rate, jnp.nan),
        stable=jnp.where(is_segment, attracts, is_fixed & decays & ~neutral & stays) & exists,
        neutral=neutral,
    )


def _outside_of(osc: Oscillator, edge: Array, *, rightward: bool) -> tuple[Array, Array]:
    """Whether the mass is held just beyond an edge, and x2' there, 0 where it is held."""
    mode, pull = at_rest_beside(osc, jnp.where(jnp.isfinite(edge), edge, 0.0), rightward=rightward)
    return mode.any_stuck, jnp.where(mode.any_stuck, 0.0, pull)


def edge_rounding(x1: Array, scale: Array | float = 1.0) -> Array:
    """Distance from a contact edge below which a fixed point counts as on the edge.

    Positions x1 and forces of size `scale` are accurate to about 1e-16 of themselves; no integrated
    arc adds to that, unlike in `force_rounding`.
    """
    return 1e-14 * (scale + jnp.abs(x1))


def at_rest_beside(osc: Oscillator, x1: Array, *, rightward: bool) -> tuple[Mode, Array]:
    """The mode of a mass at rest just beside each x1, [places], on one side, and x2' there.

    Where x2' is only rounding, as at a fixed point, it is exactly 0; its derivatives are kept.
    """
    rest = jnp.zeros_like(x1)
    mode = settle(osc, contact_beside(osc, x1, rest, rightward=rightward), x1, rest)
    a = mode_acceleration(osc, mode, x1, rest)
    return mode, jnp.where(jnp.abs(a) < edge_rounding(x1), a - lax.stop_gradient(a), a)


@jit
def side_pulls(osc: Oscillator, x1: Array) -> tuple[Array, Array]:
    """x2' of a mass at rest just left and just right of each x1, [places]; 0 where a belt holds
    it."""
    (left, pull_left), (right, pull_right) = (
        at_rest_beside(osc, x1, rightward=side) for side in (False, True)
    )
    return (
        jnp.where(left.any_stuck, 0.0, pull_left),
        jnp.where(right.any_stuck, 0.0, pull_right),
    )


@jit
def saddles(osc: Oscillator) -> Array:
    """Boolean mask [edges] of edges whose point (sigma, 0) is a saddle: both sides push away."""
    left, right = pushes_away(osc)
    return (left > 0) & (right > 0)


def pushes_away(osc: Oscillator) -> tuple[Array, Array]:
    """Accelerations away from each edge just left and right of (sigma, 0), [edges] each, or NaN."""
    positions = jnp.stack(edges(osc))
    left, right = side_pulls(osc, jnp.where(jnp.isfinite(positions), positions, 0.0))
    none = jnp.full_like(positions, jnp.nan)
    exists = jnp.isfinite(positions)
    return jnp.where(exists, -left, none), jnp.where(exists, right, none)


def _codes(mode: Mode, exists: Array) -> Array:
    codes = [jnp.where(exists, code, 0.0).astype(jnp.int8) for code in mode.codes]
    return jnp.stack(codes, axis=-1)


def _field_jacobian(osc: Oscillator, mode: Mode, x1: Array) -> Array:
    """Derivative of the field of a mode, (x1', x2'), by the state at (x1, 0), [2, 2]."""

    def field(y):
        return jnp.stack([y[1], mode_acceleration(osc, mode, y[0], y[1])])

    return jax.jacfwd(field)(jnp.stack([x1, jnp.zeros(())]))


def _eigenvalues(matrix: Array) -> Array:
    """Eigenvalues of matrices [..., 2, 2] in closed form, like eq. (26), hence differentiable."""
    half_trace = 0.5 * (matrix[..., 0, 0] + matrix[..., 1, 1])
    determinant = matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]
    discriminant = half_trace**2 - determinant
    root = jnp.sqrt(jnp.abs(discriminant))
    real, imaginary = jnp.where(discriminant < 0, 0.0, root), jnp.where(discriminant < 0, root, 0.0)
    pair = [lax.complex(half_trace + s * real, s * imaginary) for s in (1.0, -1.0)]
    return jnp.stack(pair, axis=-1)


# --- at the edges: pseudo-foci and saddles --------------------------------------------------------


def _at_edges(osc: Oscillator, positions: Array, *, with_saddles: bool) -> Equilibria:
    before = jnp.concatenate([jnp.full(1, -jnp.inf), positions[:-1]])
    # Edges that are equal up to rounding count once; those at infinity are replaced by 0.
    is_edge = jnp.isfinite(positions) & (positions - before > force_rounding(positions))
    x1 = jnp.where(is_edge, positions, 0.0)
    rest = jnp.zeros_like(x1)
    (left, a_left), (right, a_right) = (
        at_rest_beside(osc, x1, rightward=side) for side in (False, True)
    )
    focus = edge_focus(osc, left, right, x1)
    # Where a belt at rest holds the mass on one side, the edge only ends that side's segment.
    slips = is_edge & ~left.any_stuck & ~right.any_stuck
    is_focus = slips & (a_left > 0) & (a_right < 0)
    is_saddle = slips & (a_left < 0) & (a_right > 0) & with_saddles
    exists = (is_focus | is_saddle) & has_possible_numbers(osc)
    # A belt at rest brakes on the way out and on the way back: each loop takes off a fraction of
    # the velocity that does not go to 0 with it, so infinitely many loops take a finite time.
    rubs = sum(capacity(osc, contact_beside(osc, x1, rest, rightward=s)) for s in (False, True)) > 0
    rate = jnp.where(is_focus, jnp.where(rubs, -jnp.inf, focus.rate), jnp.nan)
    neutral = exists & is_focus & ~rubs & is_centre(osc, left) & is_centre(osc, right)
    x1 = jnp.where(exists, x1, jnp.nan)
    none = jnp.full_like(x1, jnp.nan)
    kind = jnp.where(is_saddle, EquilibriumKind.SADDLE.value, EquilibriumKind.PSEUDO_FOCUS.value)
    return Equilibria(
        kind=jnp.where(exists, kind, 0),
        x1=x1,
        x1_lower=x1,
        x1_upper=x1,
        modes=_codes(left, exists),
        jacobian=jnp.broadcast_to(none[:, None, None], (*x1.shape, 2, 2)),
        eigenvalues=jnp.broadcast_to(lax.complex(none, none)[:, None], (*x1.shape, 2)),
        rate=jnp.where(is_saddle, jnp.inf, rate),
        stable=(rate < 0) & ~neutral,
        neutral=neutral,
    )


def repelling_foci(osc: Oscillator) -> Array:
    """x1 of the pseudo-foci that repel, [edges], NaN for edges without one."""
    found = _at_edges(osc, jnp.sort(jnp.stack(edges(osc))), with_saddles=False)
    return jnp.where((found.rate > 0) & ~found.neutral, found.x1, jnp.nan)


# --- the Hopf point -----------------------------------------------------------------------------


@announced("lyapunov_coefficient")
def lyapunov_coefficient(osc: Oscillator) -> Array:
    """First Lyapunov coefficient a of each fixed point; positive: the Hopf point is subcritical.

    The normalisation is that of J. Guckenheimer and P. Holmes, Nonlinear Oscillations, Dynamical
    Systems, and Bifurcations of Vector Fields (1983), eq. (3.4.11): the amplitude r of x1 obeys r'
    = (trace/2) r + a r^3, so near the Hopf point there is a cycle with r^2 = -(trace/2)/a. The l1
    of Yu. A. Kuznetsov, Elements of Applied Bifurcation Theory, with eigenvectors of unit length,
    is 2 a.

    Their formula needs the linear part to be a rotation. Here it is one with unit frequency: the
    derivatives of x2' by x1 and x2 are -1 and the trace. And x1' = x2 and the spring are linear, so
    of the formula's ten derivatives only two do not vanish: d^2 x2'/dx2^2, which enters in products
    with vanishing ones only, and d^3 x2'/dx2^3. Hence a = (d^3 x2'/dx2^3) / 16.

    Args:
        osc: The oscillator at a Hopf point, where the trace of the Jacobian is 0. Elsewhere the
            number still describes the Hopf point nearby.

    Returns:
        One number for each row of `equilibria(osc)`, [equilibria], NaN for rows that are no fixed
        point.

    Raises:
        ValueError: If a parameter is impossible; the message names it.
    """
    check_oscillator(osc)
    refuse_clock(osc, "lyapunov_coefficient")
    own = in_own_units(osc)
    found, coefficients = _lyapunov_coefficients(own)
    return _existing(coefficients, found) / (1 if own is osc else own.units.length**2)


@jit
def _lyapunov_coefficients(osc: Oscillator) -> tuple[Equilibria, Array]:
    found = _all_candidates(osc)
    mode = Mode(tuple(codes.astype(found.x1.dtype) for codes in jnp.moveaxis(found.modes, -1, 0)))
    is_fixed = found.kind == EquilibriumKind.FIXED_POINT
    *_, third = derivatives_at_rest(osc, mode, jnp.zeros_like(found.x1))
    return found, jnp.where(is_fixed, third / 16, jnp.nan)
