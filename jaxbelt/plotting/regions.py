"""Region maps: a plane of two parameters, its regions, and a phase portrait of each of them."""

from collections.abc import Sequence
from typing import Any

import matplotlib.colors
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from scipy import ndimage

from ..bifurcations.regions import OPPOSITE, RegionMap, interior
from ..cycles.cycle import Cycle
from ..model.equilibria import equilibria as find_equilibria
from ..model.oscillator import Oscillator
from .diagrams import plot_curves
from .phase import draw_equilibrium, path_around
from .style import (
    BELT_COLOURS,
    belt_colour,
    draw_key,
    key_entries,
    new_figure,
    parameter_label,
)

#: Pixels of the coarse raster around the name of a region: half a letter's height, or its width.
ROOM_FOR_NAME = 3
#: Pale colours of regions whose own colour another region has already.
SPARE_COLOURS = ("#DDDDDD", "#F5E9A9", "#BFE3D0", "#F3D0E2", "#D9CBEA", "#C5D9E8", "#E8D5B9")
#: Number of rows of sketches that fit on a page.
MOST_ROWS = 4
#: Note below the map on what the names say of equilibria.
EQUILIBRIA_NOTE = (
    "after the colon:\nf fixed point\np pseudo-focus\nh held at rest\n(in brackets: not stable)"
)


def plot_region_map(regions: RegionMap, ax: Axes | None = None) -> Axes:
    """Draws the regions of a plane of two parameters, and the curves that bound them.

    Every point has the colour of its side of the curves. The colour shows what the stable cycle
    sticks to (the colour of the belt; both: violet; none: grey; several cycles: mixed); it is paler
    where an equilibrium is stable, too, and white where there is no cycle. In the plane of the
    paper's Fig. 6, and where there are contact edges, the regions have their names; elsewhere the
    key describes them. Without `ax` the figure shows the portrait of every region below the
    map, as the paper's Fig. 6 does. Returns the axes of the map.
    """
    if ax is None:
        figure = new_figure()
        figure.set_size_inches(7.2, 9.4)
        return draw_region_map(regions, figure)
    (x, y), raster = regions.values, regions.raster()
    known = np.unique(raster).tolist()
    heads = {name: _head(name) for name in known}
    unique = sorted(set(heads.values()))
    paint = map(_region_colour, unique) if regions.as_paper else _colours_of(unique)
    colours = dict(zip(unique, paint, strict=True))
    image = np.array([colours[heads[name]] for name in known])[np.searchsorted(known, raster)]
    # The image extends half a pixel beyond the ends, because pixels are centred on points.
    margins = [0.5 * (v[-1] - v[0]) / (size - 1) for v, size in zip((x, y), raster.shape)]
    extent = (x[0] - margins[0], x[-1] + margins[0], y[0] - margins[1], y[-1] + margins[1])
    style: dict[str, Any] = {"origin": "lower", "aspect": "auto", "interpolation": "nearest"}
    ax.imshow(np.swapaxes(image, 0, 1), extent=extent, zorder=0, **style)
    plot_curves(regions.curves, ax)
    if regions.as_paper or _names_equilibria(regions):
        _name_areas(ax, regions, raster)
    if not regions.as_paper:
        entries = {heads[name]: regions.words[name] for name in filter(None, known)}
        for head, words in entries.items():
            label = words.replace(f"; {OPPOSITE}", f"\n{OPPOSITE}")
            patch = {"facecolor": colours[head], "edgecolor": "0.4", "label": label}
            ax.add_patch(Rectangle((x[0], y[0]), 0, 0, **patch))
    if _names_equilibria(regions):
        ax.add_patch(Rectangle((x[0], y[0]), 0, 0, visible=False, label=EQUILIBRIA_NOTE))
    ax.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    first, second = map(parameter_label, regions.names)
    ax.set(xlabel=first, ylabel=second)
    return ax


def _name_areas(ax: Axes, regions: RegionMap, raster: np.ndarray) -> None:
    """Writes the name of each region into each of its parts that has room for it."""
    # Every fourth pixel is enough to find the parts.
    coarse = raster[::4, ::4]
    x, y = (np.linspace(v[0], v[-1], n) for v, n in zip(regions.values, coarse.shape, strict=True))
    for name in filter(None, np.unique(coarse).tolist()):
        parts: Any = ndimage.label(coarse == name)[0]  # type: ignore[index]
        for part in range(1, int(np.max(parts)) + 1):
            inside = parts == part
            size = (
                ROOM_FOR_NAME * len(name) if ":" in name else 2 * ROOM_FOR_NAME,
                2 * ROOM_FOR_NAME,
            )
            room: Any = ndimage.binary_erosion(inside, np.ones(size))
            if not np.any(room):
                continue
            row, column = interior(room)
            halo = [withStroke(linewidth=2.5, foreground="white")]
            style = {"ha": "center", "va": "center", "path_effects": halo, "zorder": 6}
            style["fontsize"] = "small" if ":" in name else None
            ax.text(x[row], y[column], name, **style)


def _colours_of(names: Sequence[str]) -> list[tuple[float, float, float]]:
    """A colour for each name of a region, no two alike."""
    spare = map(matplotlib.colors.to_rgb, SPARE_COLOURS)
    colours: list[tuple[float, float, float]] = []
    for name in names:
        colour = _region_colour(name)
        colours.append(next(spare, colour) if colour in colours else colour)
    return colours


def _head(name: str) -> str:
    """Name of a region without the part on equilibria."""
    return name.partition(":")[0]


def _names_equilibria(regions: RegionMap) -> bool:
    return any(":" in name for name in regions.regions)


def _region_colour(name: str) -> tuple[float, float, float]:
    """Pale colour for cycles, paler if an equilibrium is stable, too; white for no cycle."""
    letters = {"a": BELT_COLOURS[0], "b": BELT_COLOURS[1], "c": "#7F5FA8"}
    if not name or name[0] in "16":
        return (1.0, 1.0, 1.0)
    mixed = [matplotlib.colors.to_rgb(letters.get(letter, "#555555")) for letter in name[1:] or "s"]
    strength = 0.18 if name[0] in "25" else 0.38
    red, green, blue = 1 - strength * (1 - np.mean(mixed, axis=0))
    return float(red), float(green), float(blue)


def draw_region_map(regions: RegionMap, figure: Figure) -> Axes:
    """Draws the map, and below it a sketch of the phase portrait at an example of each region."""
    names = [name for name in regions.regions if _has_area(regions, name)] or [*regions.regions]
    named = regions.as_paper or _names_equilibria(regions)
    columns = 5 if named else 4
    rows = -(-len(names) // columns)
    if rows > MOST_ROWS:
        figure.set_size_inches(7.2, 5.6 + 1.15 * rows)
    # Two nested grids, so that the key beside the map does not take room from the sketches.
    heights = (6, 1.25 * rows) if rows <= MOST_ROWS else (5.6, 1.15 * rows)
    whole = figure.add_gridspec(2, 1, height_ratios=heights)
    upper = whole[0].subgridspec(1, 2, width_ratios=(3.2, 1) if regions.as_paper else (2.2, 1))
    ax, beside = figure.add_subplot(upper[0]), figure.add_subplot(upper[1])
    plot_region_map(regions, ax)
    if regions.as_paper:
        ax.set_aspect("equal")
    entries = key_entries([ax])
    beside.axis("off")
    key = {"loc": "center left", "borderaxespad": 0.0, "handlelength": 2.4, "frameon": False}
    beside.legend(entries.values(), entries.keys(), **key)
    lower = whole[1].subgridspec(max(rows, 1), columns)
    titles = {name: name for name in names}
    if not named:
        titles = {name: words.replace("; ", ";\n") for name, words in regions.words.items()}
    long = max((len(titles[name]) for name in names), default=0)
    size = "medium" if long < 5 else "x-small"
    for place, name in enumerate(names):
        axis = figure.add_subplot(lower[place // columns, place % columns])
        cycles = regions.cycles[name]
        _draw_sketch(axis, regions.oscillator(name), cycles)
        axis.set_title(titles[name], pad=2, fontsize=size)
    draw_key(figure, leave_out=ax)
    return ax


def _has_area(regions: RegionMap, name: str) -> bool:
    return bool(np.any((regions.label == name) & ~regions.on_line))


def _draw_sketch(ax: Axes, osc: Oscillator, cycles: Sequence[Cycle]) -> None:
    loops = [path_around(cycle) for cycle in cycles]
    rests = find_equilibria(osc)
    for i, belt in enumerate(osc.belts):
        level = float(belt.velocity / osc.omega)
        ax.axhline(level, color=belt_colour(i), linewidth=0.9, zorder=1, label=f"belt {i}")
    for cycle, loop in zip(cycles, loops, strict=True):
        style: dict[str, Any] = {"linewidth": 1.4, "label": "stable cycle"}
        if not cycle.stable:
            style = {"linewidth": 0.9, "linestyle": (0, (3, 2)), "label": "unstable cycle"}
        ax.plot(*loop.T, color="black", zorder=3, **style)
    for row in rests:
        draw_equilibrium(ax, row)
    x1 = [float(value) for rest in rests for value in (rest.x1_lower, rest.x1_upper)]
    x1 += [float(value) for loop in loops for value in (loop[:, 0].min(), loop[:, 0].max())]
    middle, reach = 0.5 * (min(x1) + max(x1)), max(0.5, 0.6 * (max(x1) - min(x1)))
    ax.set(xlim=(middle - reach, middle + reach), ylim=(-0.85, 0.85), xticks=[], yticks=[])
