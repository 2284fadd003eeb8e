"""Categories of the runs of a sweep, in a plane: each category is a colour, named in a key."""

from collections import Counter

import matplotlib
import matplotlib.colors
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from ..sweeps.datasets import decoded
from .style import figure_of, make_room

BLANK, OTHER = "not done", "other"
#: Colours that are the same in every picture; for cycles that stick see `_colour_of_kind`.
COLOURS = {
    BLANK: "#FFFFFF",
    OTHER: "#4D4D4D",
    "undecided": "#000000",
    "equilibrium": "#E6E6E6",
    "none": "#E6E6E6",
    "stuck": "#999999",
    "cycle": "#009E73",
    "cycle without sticking": "#F0E442",
    "periodic": "#009E73",
    "quasiperiodic": "#0072B2",
    "chaotic": "#D55E00",
}
#: Colours of all other categories, in order. Cycles that stick have the colour numbered by their
#: belts as binary digits: belt 0, belt 1, both, belt 2, ... (Okabe and Ito, and a violet).
SHADES = ("#56B4E9", "#E69F00", "#CC79A7", "#009E73", "#0072B2", "#D55E00", "#7F5FA8")
STICKS = "cycle, sticks to belt "
#: Largest number of categories in a key, and of letters in one of its lines.
KEY_ROOM, LINE = 8, 60


def words_of_runs(dataset: xr.Dataset, variable: str) -> xr.DataArray:
    """Category of each run in words; words of "kind" name the belts that a cycle sticks to."""
    words = decoded(dataset[[variable]])[variable].astype(object)
    if variable == "kind" and "belt" in dataset.sizes:
        sticks = dataset.sticks.transpose(*words.dims, "belt").values.astype(bool)
        sets, place = np.unique(sticks.reshape(-1, sticks.shape[-1]), axis=0, return_inverse=True)
        stuck = [" and ".join(map(str, np.flatnonzero(one))) for one in sets]
        names = [STICKS + belts if belts else "cycle without sticking" for belts in stuck]
        named = np.array(names, object)[place.ravel()].reshape(words.shape)
        words = words.where(words != "cycle", words.copy(data=named))
    words = words.where(words != "not_done", BLANK)
    return words if "status" not in dataset else words.where(dataset.status >= 0, BLANK)


def draw_categories(ax: Axes, x: np.ndarray, y: np.ndarray, words: np.ndarray) -> None:
    """Draws words [x, y] as colours, with a key; all but the most frequent become "other"."""
    counts = Counter(words.ravel().tolist())
    shown = [word for word, _ in counts.most_common(KEY_ROOM)]
    words = np.where(np.isin(words, shown), words, OTHER)
    present = sorted(np.unique(words.astype(str)).tolist(), key=_in_key)
    colours = _colours_of_words(present)
    codes = np.vectorize(present.index, otypes=[int])(words)
    shades = matplotlib.colors.ListedColormap(colours)
    top = len(present) - 0.5
    ax.pcolormesh(x, y, codes.T, cmap=shades, rasterized=True, vmin=-0.5, vmax=top)
    keys = [Patch(facecolor=colour, edgecolor="0.4") for colour in colours]
    labels = [_in_lines(word) for word in present]
    columns = 2 if max(map(len, labels)) < LINE // 2 else 1
    figure = figure_of(ax)
    make_room(figure)
    figure.legend(keys, labels, loc="outside lower center", ncols=columns, fontsize="small")


def _in_key(word: str) -> tuple[bool, bool, int, str]:
    """Sort key: short names first; "other" and "not done" last."""
    return word == BLANK, word == OTHER, len(word), word


def _colours_of_words(words: list[str]) -> list[str]:
    """A colour for each word, no two alike; words of `COLOURS` and `STICKS` have fixed ones."""
    others = [word for word in words if word not in COLOURS and not word.startswith(STICKS)]
    return [
        _shade(others.index(word)) if word in others else _colour_of_kind(word) for word in words
    ]


def _colour_of_kind(word: str) -> str:
    if word in COLOURS:
        return COLOURS[word]
    belts = map(int, word.removeprefix(STICKS).split(" and "))
    return _shade(sum(2**belt for belt in belts) - 1)


def _shade(number: int) -> str:
    """Colour number `number`: first the colours of `SHADES`, then hues that do not repeat."""
    if number < len(SHADES):
        return SHADES[number]
    hue = 0.618034 * number % 1.0  # multiples of the golden section spread over the circle
    red, green, blue = matplotlib.colors.hsv_to_rgb((hue, 0.55, 0.75)).tolist()
    return matplotlib.colors.to_hex((red, green, blue))


def _in_lines(word: str) -> str:
    """Breaks a sequence of events into lines that fit into a key."""
    lines = [""]
    for event in word.split("-"):
        if lines[-1] and len(lines[-1]) + len(event) > LINE:
            lines.append("")
        lines[-1] += f"{event}-"
    return "\n".join(lines).removesuffix("-")
