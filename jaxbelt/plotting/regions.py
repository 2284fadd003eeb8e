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

#: Pixels of the coarse raster around the name of a region: half a letter's height.
ROOM_FOR_NAME = 3
#: Colours of regions that have none by the belts that their cycle sticks to (pale).
SPARE_COLOURS = ("#DDDDDD", "#F5E9A9", "#BFE3D0", "#F3D0E2", "#D9CBEA", "#C5D9E8", "#E8D5B9")


def plot_region_map(regions: RegionMap, ax: Axes | None = None) -> Axes:
    """The regions of a plane of two parameters, and the curves that bound them.

    Every point has the colour of its own side of each curve. The colour tells what the stable cycle
    sticks to (that of the belt; both: violet; none: white), paler where an equilibrium is stable,
    too. In the plane of the paper's Fig. 6 the regions have the paper's names, elsewhere the key
    tells what there is. Without `ax` a figure is made that shows the portrait of every region below
    the map, as the paper's Fig. 6 does. Returns the axes of the map.
    """
    if ax is None:
        figure = new_figure()
        figure.set_size_inches(7.2, 9.4)
        return draw_region_map(regions, figure)
    (x, y), raster = regions.values, regions.raster()
    known = np.unique(raster).tolist()
    paint = map(_region_colour, known) if regions.as_paper else _colours_of(known)
    colours = dict(zip(known, paint, strict=True))
    image = np.array([colours[name] for name in known])[np.searchsorted(known, raster)]
    # Half a pixel beyond the ends: pixels stand for points.
    margins = [0.5 * (v[-1] - v[0]) / (size - 1) for v, size in zip((x, y), raster.shape)]
    extent = (x[0] - margins[0], x[-1] + margins[0], y[0] - margins[1], y[-1] + margins[1])
    style: dict[str, Any] = {"origin": "lower", "aspect": "auto", "interpolation": "nearest"}
    ax.imshow(np.swapaxes(image, 0, 1), extent=extent, zorder=0, **style)
    plot_curves(regions.curves, ax)
    if regions.as_paper:
        _name_areas(ax, regions, raster)
    else:
        words = regions.words
        for name in filter(None, known):
            label = words[name].replace(f"; {OPPOSITE}", f"\n{OPPOSITE}")
            patch = {"facecolor": colours[name], "edgecolor": "0.4", "label": label}
            ax.add_patch(Rectangle((x[0], y[0]), 0, 0, **patch))
    ax.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    first, second = map(parameter_label, regions.names)
    ax.set(xlabel=first, ylabel=second)
    return ax


def _name_areas(ax: Axes, regions: RegionMap, raster: np.ndarray) -> None:
    """The name of each region in each of its parts that has room for it."""
    # A part is told well enough by every fourth pixel.
    coarse = raster[::4, ::4]
    x, y = (np.linspace(v[0], v[-1], n) for v, n in zip(regions.values, coarse.shape, strict=True))
    for name in filter(None, np.unique(coarse).tolist()):
        parts: Any = ndimage.label(coarse == name)[0]  # type: ignore[index]
        for part in range(1, int(np.max(parts)) + 1):
            inside = parts == part
            if not np.any(ndimage.binary_erosion(inside, iterations=ROOM_FOR_NAME)):
                continue
            row, column = interior(inside)
            halo = [withStroke(linewidth=2.5, foreground="white")]
            style = {"ha": "center", "va": "center", "path_effects": halo, "zorder": 6}
            ax.text(x[row], y[column], name, **style)


def _colours_of(names: Sequence[str]) -> list[tuple[float, float, float]]:
    """A colour for each name of a region, no two alike, for a key to tell them."""
    spare = map(matplotlib.colors.to_rgb, SPARE_COLOURS)
    colours: list[tuple[float, float, float]] = []
    for name in names:
        colour = _region_colour(name)
        colours.append(next(spare, colour) if colour in colours else colour)
    return colours


def _region_colour(name: str) -> tuple[float, float, float]:
    """Pale for cycles, paler where an equilibrium is stable beside them; white for no cycle."""
    letters = {"a": BELT_COLOURS[0], "b": BELT_COLOURS[1], "c": "#7F5FA8"}
    if not name or name[0] in "16":
        return (1.0, 1.0, 1.0)
    colour = np.array(matplotlib.colors.to_rgb(letters.get(name[1:2], "#555555")))
    strength = 0.18 if name[0] in "25" else 0.38
    red, green, blue = 1 - strength * (1 - colour)
    return float(red), float(green), float(blue)


def draw_region_map(regions: RegionMap, figure: Figure) -> Axes:
    """The map above, below it a sketch of the phase portrait of each region, in its example."""
    names = [name for name in regions.regions if _has_area(regions, name)]
    columns = 5 if regions.as_paper else 4
    rows = -(-len(names) // columns)
    # Grids of their own: what the key takes beside the map leaves the sketches alone.
    whole = figure.add_gridspec(2, 1, height_ratios=(6, 1.25 * rows))
    upper = whole[0].subgridspec(1, 2, width_ratios=(3.2, 1) if regions.as_paper else (2.2, 1))
    ax, beside = figure.add_subplot(upper[0]), figure.add_subplot(upper[1])
    plot_region_map(regions, ax)
    if regions.as_paper:
        ax.set_aspect("equal")
    entries = key_entries([ax])
    beside.axis("off")
    key = {"loc": "center left", "borderaxespad": 0.0, "handlelength": 2.4, "frameon": False}
    beside.legend(entries.values(), entries.keys(), **key)
    lower = whole[1].subgridspec(rows, columns)
    titles = {name: name for name in names}
    if not regions.as_paper:
        titles = {name: words.replace("; ", ";\n") for name, words in regions.words.items()}
    for place, name in enumerate(names):
        axis = figure.add_subplot(lower[place // columns, place % columns])
        cycles = regions.cycles[name]
        _draw_sketch(axis, regions.oscillator(name), cycles, titles[name])
    draw_key(figure, leave_out=ax)
    return ax


def _has_area(regions: RegionMap, name: str) -> bool:
    return bool(np.any((regions.label == name) & ~regions.on_line))


def _draw_sketch(ax: Axes, osc: Oscillator, cycles: Sequence[Cycle], name: str) -> None:
    loops = [path_around(cycle) for cycle in cycles]
    rests = find_equilibria(osc)
    x1 = float(rests.x1[0])
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
    reach = max([0.5, *(1.2 * float(np.max(np.abs(loop[:, 0] - x1))) for loop in loops)])
    ax.set(xlim=(x1 - reach, x1 + reach), ylim=(-0.85, 0.85), xticks=[], yticks=[])
    ax.set_title(name, pad=2, fontsize="medium" if len(name) < 5 else "x-small")
