"""Branches of a diagram, `Branch`: the piece of each between two neighbouring points of `scan`, and
how pieces are joined, see `diagrams`."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks import require
from ..cycles.attractors import MAYBE_SAME, distance
from ..cycles.chains import Loop, cut
from ..cycles.cycle import Cycle, exactly, polish
from ..model.equilibria import candidates
from ..model.events import signature_name
from ..model.oscillator import Oscillator
from ..model.own_units import quantity
from ..numerics.compiling import jit
from ..results import Status
from ..tables import per_belt
from .base import BifurcationPoint
from .labels import Label
from .path import ParameterPath

#: Distances between ends of branches are relative to the size of the motion, or to this if larger.
LEAST_SIZE = 0.1


class Branch(eqx.Module):
    """Equilibria or cycles along a path in one parameter: a struct of arrays, one row for each
    value.

    Attributes:
        kind: "equilibrium" or "cycle".
        values: Values of the parameter, [rows]; they turn back at a fold.
        stable: Stability, [rows].
        neutral: Whether it is a centre, see `Equilibria`, [rows]; False for cycles.
        x1_min: Smallest x1 of the motion, [rows]; for a segment of pseudo-equilibria its lower end.
        x1_max: Largest x1, likewise.
        x2_min: Smallest x2, likewise.
        x2_max: Largest x2, likewise.
        period: Periods of cycles, else NaN, [rows].
        multiplier: Nontrivial multipliers of cycles, else NaN, [rows].
        stick_durations: Time stuck to each belt in one loop, [rows, belts]; NaN where a cycle does
            not stick to that belt.
        stick_velocities: Velocity of the belt over omega, likewise.
        cycles: A `Cycle` for each row; none for equilibria. For forced oscillators a
            `PeriodicMotion` for each row; `multiplier` is then the real part of the larger one.
    """

    kind: str = eqx.field(static=True)
    values: np.ndarray
    stable: np.ndarray
    neutral: np.ndarray
    x1_min: np.ndarray = eqx.field(metadata=quantity("length"))
    x1_max: np.ndarray = eqx.field(metadata=quantity("length"))
    x2_min: np.ndarray = eqx.field(metadata=quantity("velocity"))
    x2_max: np.ndarray = eqx.field(metadata=quantity("velocity"))
    period: np.ndarray
    multiplier: np.ndarray
    stick_durations: np.ndarray
    stick_velocities: np.ndarray = eqx.field(metadata=quantity("velocity"))
    cycles: tuple[Any, ...]

    @property
    def amplitude(self) -> np.ndarray:
        """Half the range of x1 for cycles, 0 for equilibria, [rows]."""
        moves = self.kind == "cycle"
        return 0.5 * (self.x1_max - self.x1_min) if moves else np.zeros(len(self))

    def evaluated(self, functional: Callable[[Cycle], Any]) -> np.ndarray:
        """Values of a functional of the cycles, [rows], NaN where there is none.

        The functional gets one concrete `Cycle` after another, so JAX need not be able to trace it.
        """
        if not self.cycles:
            return np.full(len(self), np.nan)
        values = [np.asarray(functional(cycle)) for cycle in self.cycles]
        for value in values:
            fits = value.ndim == 0 and np.issubdtype(value.dtype, np.number)
            returned = f"one that returns {value.dtype}{list(value.shape)}"
            require(fits, "quantity", "a function of a cycle that returns one number", returned)
        return np.array(values, float)

    def columns(self) -> dict[str, Any]:
        """Columns of the table of a diagram for its rows."""
        names = ("stable", "neutral", "x1_min", "x1_max", "x2_min", "x2_max", "period", "amplitude")
        events = [signature_name(cycle.signature) for cycle in self.cycles]
        return {
            "kind": [self.kind] * len(self),
            "belts": [""] * len(self),
            "type": [""] * len(self),
            "value": self.values,
            **{name: getattr(self, name) for name in (*names, "multiplier")},
            # Where a stick phase vanishes Newton's method leaves rounding, which may be negative.
            **per_belt("stick_duration", np.maximum(self.stick_durations, 0.0)),
            "signature": events or [""] * len(self),
        }

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        ends = f"{self.values[0]:.6g} to {self.values[-1]:.6g}"
        flips = int(np.sum(self.stable[1:] != self.stable[:-1]))
        first = "stable" if self.stable[0] else "neutral" if self.neutral[0] else "unstable"
        return f"Branch({self.kind}, {len(self)} rows, {ends}, {first} first, {flips} changes)"


def nodes_of_stretch(path: ParameterPath, a: float, b: float, rows: int) -> np.ndarray:
    """Values from a to b, denser at both ends; special values give way to the ones beside them."""
    # Short stretches are no less curved than long ones: with fewer rows corners would be visible.
    count = max(9, rows // 9, round(rows * (b - a) / path.length))
    inner = 0.5 * (1 - np.cos(np.linspace(0, np.pi, count)))
    first = path.beside(a)[1] if a in path.breaks or a != path.first else a
    last = path.beside(b)[0] if b in path.breaks or b != path.last else b
    if first >= last:  # the range beside one of them reaches the other
        first, last = a + path.closest, b - path.closest
    return first + (last - first) * inner


def separated_stretches(labels: Sequence[Label]) -> list[tuple[int, int]]:
    """Where unstable cycles may separate stable equilibria from attracting cycles.

    Returns a list of (number of the stretch, number of the equilibrium, segments not counted).
    """
    return [
        (stretch, around)
        for stretch, label in enumerate(labels)
        if label.cycles
        for around in range(label.foci)
    ]


class _Piece(NamedTuple):
    """A branch within one stretch, rows from left to right, and the number of the stretch."""

    branch: Branch
    stretch: int


def equilibrium_pieces(path: ParameterPath, nodes: Sequence[np.ndarray]) -> list[_Piece]:
    """The pieces of equilibria; nodes: the values of each stretch."""
    found = _stacked(candidates, map(path.at, np.concatenate(nodes)))
    pieces = []
    for stretch, rows in enumerate(_consecutive(nodes)):
        values, here = nodes[stretch], jax.tree.map(lambda x, rows=rows: x[rows], found)
        none = np.full(len(values), np.nan)
        none_stick = np.full((len(values), len(path.osc.belts)), np.nan)
        for row in range(int(np.max(np.sum(here.kind > 0, axis=1)))):
            branch = Branch(
                kind="equilibrium",
                values=values,
                stable=here.stable[:, row],
                neutral=here.neutral[:, row],
                x1_min=here.x1_lower[:, row],
                x1_max=here.x1_upper[:, row],
                x2_min=np.zeros(len(values)),
                x2_max=np.zeros(len(values)),
                period=none,
                multiplier=none,
                stick_durations=none_stick,
                stick_velocities=none_stick,
                cycles=(),
            )
            pieces.append(_Piece(branch, stretch))
    return pieces


def cycle_pieces(
    path: ParameterPath, nodes: Sequence[np.ndarray], labels: Sequence[Label]
) -> list[_Piece]:
    """The pieces of cycles, attracting and unstable; nodes: values of each stretch; labels: a label
    of each."""
    wanted: list[tuple[int, np.ndarray, list[Loop]]] = []
    for stretch in range(len(labels)):
        for loops in path.strands(nodes[stretch].tolist()):
            wanted.append((stretch, np.array(list(loops)), list(loops.values())))
    pieces = []
    if wanted:
        groups = [values for _, values, _ in wanted]
        loops = [loop for _, _, group in wanted for loop in group]
        cycles = _attracting(path, np.concatenate(groups), loops)
        pieces += _as_pieces(cycles, groups, [stretch for stretch, _, _ in wanted])
    both = separated_stretches(labels)
    if both:
        groups = [nodes[stretch] for stretch, _ in both]
        found = [path.unstable_along(nodes[stretch], around) for stretch, around in both]
        cycles = [cycle for group in found for cycle in group]
        pieces += _as_pieces(cycles, groups, [stretch for stretch, _ in both])
    return pieces


def _as_pieces(cycles: Sequence[Cycle], groups, stretches) -> list[_Piece]:
    pieces, found = [], _stacked(_row_of_branch, cycles)
    status = found.pop("status")
    for stretch, values, rows in zip(stretches, groups, _consecutive(groups), strict=True):
        fine = status[rows] == Status.OK
        if np.any(fine):
            fields = {name: column[rows[fine]] for name, column in found.items()}
            own = tuple(cycles[row] for row in rows[fine].tolist())
            branch = Branch(kind="cycle", values=values[fine], cycles=own, **fields)
            pieces.append(_Piece(branch, stretch))
    return pieces


@jit
def _row_of_branch(cycle: Cycle) -> dict[str, Array]:
    """The fields of a `Branch` at a cycle, and its status."""
    osc, chain = cycle.oscillator, cycle.chain
    stuck = jnp.any((chain.codes == 0) & chain.used[:, None], axis=0)
    speeds = jnp.stack([belt.velocity / osc.omega for belt in osc.belts])
    return dict(
        status=cycle.status,
        stable=cycle.stable,
        neutral=jnp.zeros_like(cycle.stable),
        x1_min=cycle.x1_min,
        x1_max=cycle.x1_max,
        x2_min=cycle.x2_min,
        x2_max=cycle.x2_max,
        period=cycle.period,
        multiplier=cycle.multiplier,
        stick_durations=jnp.where(stuck, cycle.stick_durations, jnp.nan),
        stick_velocities=jnp.where(stuck, speeds, jnp.nan),
    )


def _consecutive(groups: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Row numbers of each group in the concatenation of all groups."""
    ends = np.cumsum([len(group) for group in groups])
    return [np.arange(end - len(group), end) for group, end in zip(groups, ends, strict=True)]


def _stacked(program, items: Iterable[Any]) -> Any:
    """Results of a program for each item, as NumPy arrays of many rows.

    The items are computed one by one, so that one compiled program serves any number of them.
    """
    rows = [jax.tree.map(np.asarray, program(item)) for item in items]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def _attracting(path: ParameterPath, values: np.ndarray, loops: Sequence[Loop]) -> list[Cycle]:
    ok = jnp.asarray(Status.OK.value)

    def solved(osc: Oscillator, loop: Loop) -> Cycle:
        cycle = polish(osc, loop, ok)
        # The integration steps are too long for the law; a branch must not end for that.
        return exactly(osc, loop, ok) if int(cycle.status) == Status.NO_CONVERGENCE else cycle

    pairs = zip(values, cut(loops), strict=True)
    return [solved(path.at(value), loop) for value, loop in pairs]


class _End(NamedTuple):
    """An end of a piece: number of the piece, whether it is the right end, and its place."""

    piece: int
    right: bool
    place: tuple[str, float, float]


def joined_pieces(
    pieces: Sequence[_Piece], special: Sequence[list[BifurcationPoint]]
) -> list[Branch]:
    """Joins pieces to branches.

    special: the points between neighbouring stretches, a list for each value. Two ends of pieces
    that have the same place at such a value are joined.
    """
    partner: dict[tuple[int, bool], tuple[int, bool]] = {}
    for at, points in enumerate(special):
        if not all(point.condition.joins for point in points):
            continue
        ends = [
            _end(i, piece, right=piece.stretch == at)
            for i, piece in enumerate(pieces)
            if piece.stretch in (at, at + 1)
        ]
        pairs = sorted(
            (_between(a, b), i, j) for (i, a), (j, b) in combinations(enumerate(ends), 2)
        )
        taken: set[int] = set()
        for away, i, j in pairs:
            if away < MAYBE_SAME and not taken & {i, j}:
                taken |= {i, j}
                for a, b in ((ends[i], ends[j]), (ends[j], ends[i])):
                    partner[a.piece, a.right] = (b.piece, b.right)
    branches, left = [], set(range(len(pieces)))
    while left:
        # Begin at an end that has no partner; a closed branch may begin anywhere.
        free = [(i, r) for i in sorted(left) for r in (False, True) if (i, r) not in partner]
        at = (free or [(min(left), False)])[0]
        chain = []
        while at is not None and at[0] in left:
            left.remove(at[0])
            branch = pieces[at[0]].branch
            chain.append(_reversed(branch) if at[1] else branch)
            at = partner.get((at[0], not at[1]))
        branches.append(_chained(chain))
    return branches


def _end(number: int, piece: _Piece, *, right: bool) -> _End:
    branch, row = piece.branch, -1 if right else 0
    return _End(number, right, (branch.kind, float(branch.x1_min[row]), float(branch.x1_max[row])))


def _between(a: _End, b: _End) -> float:
    """Distance of two ends relative to the motion; inf between an equilibrium and a cycle."""
    (kind, *x), (other, *y) = a.place, b.place
    return distance(x, y, least=LEAST_SIZE) if kind == other else np.inf


def _reversed(branch: Branch) -> Branch:
    arrays = jax.tree.map(lambda leaf: leaf[::-1], replace(branch, cycles=()))
    return replace(arrays, cycles=branch.cycles[::-1])


def _chained(parts: Sequence[Branch]) -> Branch:
    bare = [replace(part, cycles=()) for part in parts]
    arrays = jax.tree.map(lambda *leaves: np.concatenate(leaves), *bare)
    return replace(arrays, cycles=tuple(cycle for part in parts for cycle in part.cycles))
