"""The motions in the cells of a map: `motions_in_cells`; and the names of regions.

A cell is a point of a plane of two parameters. Its equilibria are known in closed form. Its cycles
are those that runs lead to, from the starts from which `scan` follows orbits: ends of stick phases,
which every cycle that sticks passes, and several distances from an equilibrium. So the same cycles
are found in a cell as on a path through it.
"""

import re
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..cycles.attractors import RUN, Runs, stuck_belts
from ..model.equilibria import EquilibriumKind, candidates
from ..model.oscillator import Oscillator
from ..numerics.compiling import jit
from ..presets import class_b
from ..results import Status
from ..sweeps.attractor import CYCLE, UNDECIDED, Attractor, signature
from ..sweeps.fractions import PLACE
from ..sweeps.grid import Grid
from ..sweeps.question import LONG_ENOUGH
from ..sweeps.runs_in_memory import results_of
from ..sweeps.shares import numbers_of_attractors
from .guesses import starts as starts_of_scan
from .labels import Label

#: Velocities that differ by less are equal up to rounding.
SAME_VELOCITY = 1e-12
#: Tolerance of the runs.
RUN_TOLERANCE = 1e-8
#: Letters of equilibria in the names of regions.
LETTERS = {
    EquilibriumKind.FIXED_POINT: "f",
    EquilibriumKind.PSEUDO_FOCUS: "p",
    EquilibriumKind.SEGMENT: "h",
}
#: The letter of a cycle that never sticks.
NEVER_STICKS = "s"


# --- names ----------------------------------------------------------------------------------------


def region_name(osc: Oscillator, label: Label) -> str:
    """Name of a region with this label, in the manner of the paper's Fig. 6.

    A digit: 1 there is a stable equilibrium only; 2 a stable cycle, too; 3 a stable cycle only.
    Where belts run in opposite directions these are 6, 5 and 4. With several belts a letter for
    each cycle shows what it sticks to: a belt 0, b belt 1, c both, s none. With more belts the
    letter's number has the belts as binary digits; from s (19) on, belts are in square brackets.

    With contact edges there may be several equilibria, of several kinds. There the digit is 1, 2 or
    3 in whatever directions belts run, and after a colon the equilibria follow from left to right:
    f a fixed point, p a pseudo-focus, h a segment that holds; in brackets those that do not
    attract.
    """
    velocities = [float(belt.velocity) for belt in osc.belts]
    opposite = min(velocities) < 0 < max(velocities)
    rests = [(kind, stable) for kind, stable, _ in label.equilibria]
    stuck = [stuck_belts(path) for path in label.cycles]
    return _name(_is_edged(osc), opposite, len(velocities), rests, stuck)


def _is_edged(osc: Oscillator) -> bool:
    return bool(np.any(np.isfinite([(belt.lower, belt.upper) for belt in osc.belts])))


def _letter_of(stuck: Collection[int]) -> str:
    """The letter of a cycle that sticks to these belts, or their numbers in square brackets."""
    code = sum(2**belt for belt in set(stuck))
    if ord("a") + code - 1 < ord(NEVER_STICKS):
        return chr(ord("a") + code - 1) if code else NEVER_STICKS
    return f"[{','.join(map(str, sorted(set(stuck))))}]"


def belts_of_letters(letters: str) -> list[list[int]]:
    """The belts to which each cycle in the name of a region sticks."""
    found = []
    for letter in re.findall(r"\[[\d,]+\]|[a-z]", letters):
        if letter.startswith("["):
            found.append([int(belt) for belt in letter[1:-1].split(",")])
        else:
            code = 0 if letter == NEVER_STICKS else ord(letter) - ord("a") + 1
            found.append([belt for belt in range(code.bit_length()) if code >> belt & 1])
    return found


def _name(
    edged: bool,
    opposite: bool,
    belts: int,
    equilibria: Sequence[tuple[int, bool]],
    cycles: Sequence[Collection[int]],
) -> str:
    """Like `region_name`, from the properties that it depends on; "" where nothing attracts.

    edged: whether there are contact edges; opposite: whether belts run in opposite directions;
    belts: their number; equilibria: (kind, stable), from left to right; cycles: the belts to which
    each one sticks.
    """
    rests = any(stable for _, stable in equilibria)
    if not rests and not cycles:
        return ""
    number = 2 if rests and cycles else 3 if cycles else 1
    letters = [_letter_of(stuck) for stuck in cycles]
    tail = "".join(sorted(letters)) if belts > 1 else "s" * letters.count("s")
    if not edged:
        return f"{7 - number if opposite else number}{tail}"
    kinds = ((LETTERS[EquilibriumKind(kind)], stable) for kind, stable in equilibria)
    words = (letter if stable else f"({letter})" for letter, stable in kinds)
    return f"{number}{tail}:{''.join(words)}"


def in_plane_of_paper(oscillators: Sequence[Oscillator]) -> bool:
    """Whether oscillators lie in the plane of the paper's Fig. 6, where regions have its names.

    That is class (b) with the paper's friction, loads and damping, and any velocities of the belts.
    """

    def is_there(osc: Oscillator) -> bool:
        paper = class_b(*([belt.velocity for belt in osc.belts] * 2)[:2])
        same = jax.tree.structure(osc) == jax.tree.structure(paper)
        pairs = zip(jax.tree.leaves(osc), jax.tree.leaves(paper), strict=True) if same else ()
        return same and all(np.array_equal(one, other) for one, other in pairs)

    return all(map(is_there, oscillators))


# --- what there is --------------------------------------------------------------------------------


class Cells(NamedTuple):
    """The motions in each cell, arrays [cells].

    names: of the regions, "" where runs were undecided or nothing attracts. motions: numbers, equal
    in cells where kind, stability and contacts of all equilibria, and events and stuck belts of all
    cycles, agree; -1 where runs were undecided. on_line: whether a belt is at rest or without
    load, or two belts have one velocity, unless this is so in all cells.
    """

    names: np.ndarray
    motions: np.ndarray
    on_line: np.ndarray


def motions_in_cells(
    make: Callable[..., Oscillator],
    names: Sequence[str],
    points: np.ndarray,
    starts: Sequence[tuple[float, float]] = (),
) -> Cells:
    """The motions at points of a plane, [cells, 2], the values of two arguments of `make`.

    starts: further starts, (x1, x2), of the runs in each cell.
    """
    points = np.asarray(points, float)
    still: Any = jax.tree.map(np.asarray, _still_at(make, tuple(names), jnp.asarray(points)))
    decided, cycles, sticks = _cycles_at(make, names, points, still, np.reshape(starts, (-1, 2)))
    opposite = (still.velocities.min(-1) < 0) & (still.velocities.max(-1) > 0)
    count = len(points)
    rests = [still.kind, still.stable, still.modes.reshape(count, -1)]
    facts = np.concatenate([decided[:, None], opposite[:, None], *rests, cycles], axis=1)
    kinds, first, which = np.unique(facts, axis=0, return_index=True, return_inverse=True)
    edged, belts = _is_edged(made_at(make, names, points[0])), still.velocities.shape[1]
    named, numbers, known = [], [], {}
    for row, cell in zip(kinds.tolist(), first.tolist(), strict=True):
        here = still.kind[cell] > 0
        pairs = zip(still.kind[cell][here].tolist(), still.stable[cell][here].tolist(), strict=True)
        stuck = [sticks[number] for number in row[-cycles.shape[1] :] if number >= 0]
        name = _name(edged, bool(row[1]), belts, list(pairs), stuck)
        named.append(name if row[0] else "")
        number = known.setdefault(tuple(row[2:]), len(known))
        numbers.append(number if row[0] else -1)
    which = which.reshape(count)
    return Cells(np.array(named)[which], np.array(numbers)[which], _on_line(still))


def made_at(make: Callable[..., Oscillator], names: Sequence[str], point: Any) -> Oscillator:
    """The oscillator that a function of two arguments makes at a point of the plane."""
    return make(**dict(zip(names, map(float, point), strict=True)))


def _on_line(still: "_Still") -> np.ndarray:
    """Mask of cells where a belt is at rest or idle, or two have one velocity, if not in all."""
    # A belt at rest has the velocity of the frame, which counts as one more belt.
    velocities = np.asarray(still.velocities)
    count, n = velocities.shape
    others = np.append(velocities, np.zeros((count, 1)), axis=-1)
    meet = np.abs(velocities[:, :, None] - others[:, None, :]) < SAME_VELOCITY
    meet = meet & ~np.eye(n, n + 1, dtype=bool)
    holds = np.concatenate([meet.reshape(count, -1), still.idle], axis=1)
    return np.any(holds & ~np.all(holds, axis=0), axis=1)


class _Still(NamedTuple):
    """What is computed for the cells before any run.

    kind, stable: of the equilibria, [cells, equilibria]; modes: [.., belts]; velocities, and which
    belts are idle, without load: [cells, belts]; starts: of `scan`, [cells, starts, 2]; leaves: of
    the oscillators, [cells] each.
    """

    kind: Array
    stable: Array
    modes: Array
    velocities: Array
    idle: Array
    starts: Array
    leaves: list[Array]


@jit
def _still_at(make, names, points: Array) -> _Still:
    def one(pair):
        osc = make(**dict(zip(names, pair, strict=True)))
        rests = candidates(osc)
        velocities = jnp.stack([belt.velocity for belt in osc.belts])
        starts = starts_of_scan(osc, rests)
        # Contacts of a belt without load, which does nothing, make no difference.
        idle = jnp.stack([belt.load for belt in osc.belts]) == 0
        modes = jnp.where(idle, 0, rests.modes)
        leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(osc)]
        return _Still(rests.kind, rests.stable, modes, velocities, idle, starts, leaves)

    return jax.vmap(one)(points)


def _cycles_at(make, names, points, still: _Still, more: np.ndarray):
    """Mask of the decided cells, [cells], and the sorts of the cycles in them.

    The sorts are numbers, ascending, padded with -1, [cells, cycles]; the last result is the list
    of the belts to which each sort sticks.
    """
    belts = still.velocities.shape[1]
    results, ran = _runs_from(make, names, points, still, more)
    kinds = results["kind"].astype(int)
    escapes = results["status"] == Status.NOT_FINITE
    decided = ~np.any(ran & (kinds == UNDECIDED) & ~escapes, axis=1)
    sticks = results["sticks"].astype(int)
    known, which = np.unique(results["signature"], return_inverse=True)
    signatures = np.array([signature(int(word) if word < 2**53 else -1, belts) for word in known])
    places = np.stack([results[name] for name in PLACE], axis=-1)
    runs = Runs(places, signatures[which.reshape(kinds.shape)], RUN * RUN_TOLERANCE)
    cycles = np.where(kinds == CYCLE, kinds, UNDECIDED)
    labels = numbers_of_attractors(
        cycles, sticks, runs, lambda point: made_at(make, names, points[point])
    )
    codes = sticks @ 2 ** np.arange(belts)
    sorts: dict[tuple[str, int], int] = {}
    count = int(labels.max(initial=-1)) + 1
    found = np.full((len(points), max(count, 1)), -1)
    for number in range(count):
        has, first = np.any(labels == number, axis=1), np.argmax(labels == number, axis=1)
        for at in np.flatnonzero(has):
            sort = str(runs.signatures[at, first[at]]), int(codes[at, first[at]])
            found[at, number] = sorts.setdefault(sort, len(sorts))
    stuck = [[belt for belt in range(belts) if code >> belt & 1] for _, code in sorts]
    return decided, np.sort(found, axis=1), stuck


def _runs_from(make, names, points, still: _Still, more: np.ndarray):
    """Results of the observer `Attractor`, by name, [cells, starts, ..], and a mask of the runs."""
    grid = Grid(make, {name: points[:1, i] for i, name in enumerate(names)}, (0.0, 0.0))
    begun = np.broadcast_to(more, (len(points), *more.shape))
    begun = np.concatenate([still.starts, begun], axis=1)
    ran = np.all(np.isfinite(begun), axis=-1)
    cell, start = np.nonzero(ran)
    pairs = zip(still.leaves, grid.mapped, strict=True)
    varying = [leaf for leaf, varies in pairs if varies]

    def rows_of(first: int, last: int) -> np.ndarray:
        at = cell[first:last]
        states = begun[at, start[first:last]].T
        return np.concatenate([states, [leaf[at] for leaf in varying]])[None]

    numbers = {"t1": LONG_ENOUGH, "rtol": RUN_TOLERANCE, "atol": RUN_TOLERANCE}
    results = {}
    columns = results_of(grid.program(Attractor()), grid.shared, rows_of, len(cell), **numbers)
    for name, column in columns.items():
        results[name] = np.zeros((*ran.shape, *column.shape[1:]))
        results[name][ran] = np.nan_to_num(column)
    return results, ran
