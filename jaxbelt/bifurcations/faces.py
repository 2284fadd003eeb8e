"""The parts into which curves cut a plane of two parameters: each has one name.

The cells of a map are coarse, its curves are exact. On a raster much finer than the cells the
curves are walls, and a face is what can be reached without passing one. A face has the name of the
cells in it; where no cell lies in it, a point well inside of it is computed. So every pixel has the
name of its own side of every curve, however coarse the cells are. Where curves do not bound a face,
the nearest cell in it decides.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

#: Pixels along each side of the raster: a line of a picture is a few of them wide.
PIXELS = 900
#: Width of the strip along a wall, in pixels, whose cells and faces are ignored: a chord of a bent
#: curve may be off by so much.
LEFT_OUT = 3.0

#: First and last value of each of the two parameters.
Span = tuple[tuple[float, float], tuple[float, float]]


class Faces:
    """The faces of a plane.

    span: of the parameters; paths: of the curves, [rows, 2] each. number: the face of each pixel,
    from 1, [PIXELS, PIXELS], the first parameter along the rows; 0 on a curve. depth: distance from
    the nearest curve, in pixels.
    """

    def __init__(self, span: Span, paths: Sequence[np.ndarray]):
        # The import takes a quarter of a second, which only maps need.
        from scipy.ndimage import distance_transform_edt, label

        self.low, self.high = np.array(span).T
        wall = np.zeros((PIXELS, PIXELS), bool)
        for path in paths:
            at = densely(self._scaled(path), 0.5)
            inside = np.all((at > -0.5) & (at < PIXELS - 0.5), axis=1)
            wall[tuple(np.rint(at[inside]).astype(int).T)] = True
        found: Any = label(~wall)
        self.number, self.count = np.asarray(found[0]), int(found[1])
        self.depth = np.full(wall.shape, float(PIXELS))
        if np.any(wall):
            self.depth = np.asarray(distance_transform_edt(~wall))

    def _scaled(self, points: np.ndarray) -> np.ndarray:
        """Points of the plane in units of pixels, [points, 2]."""
        return (points - self.low) / (self.high - self.low) * (PIXELS - 1)

    def _pixel(self, point: np.ndarray) -> tuple[int, int]:
        row, column = np.rint(self._scaled(point)).astype(int).clip(0, PIXELS - 1)
        return int(row), int(column)

    def unnamed(self, points: np.ndarray) -> list[tuple[float, float]]:
        """A point well inside each face that contains none of the points.

        Faces that are hardly wider than a line are left out.
        """
        from scipy.ndimage import maximum, maximum_position

        known = np.zeros(self.count + 1, bool)
        for point in points:
            at = self._pixel(point)
            known[self.number[at]] |= bool(self.depth[at] > LEFT_OUT)
        left = np.flatnonzero(~known[1:]) + 1
        deepest = np.atleast_1d(maximum(self.depth, self.number, left))
        left = left[deepest > LEFT_OUT]
        places = maximum_position(self.depth, self.number, left) if left.size else []
        step = (self.high - self.low) / (PIXELS - 1)
        return [(float(p), float(q)) for p, q in (self.low + np.array(at) * step for at in places)]

    def named(self, points: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Name of each pixel, from points with names, [PIXELS, PIXELS]; "" without any points."""
        from scipy.ndimage import find_objects

        known = sorted(set(names)) or [""]
        seeds = np.full(self.number.shape, -1)
        for point, name in zip(points, names, strict=True):
            at = self._pixel(point)
            if self.depth[at] > LEFT_OUT:
                seeds[at] = known.index(name)
        codes = np.full(self.number.shape, -1)
        for face, box in enumerate(find_objects(self.number), start=1):
            inside = self.number[box] == face
            own = np.where(inside, seeds[box], -1)
            present = np.unique(own[own >= 0])
            if present.size == 1:
                codes[box][inside] = present[0]
            elif present.size:
                codes[box][inside] = _filled(own)[inside]
        return np.array(known)[_filled(codes)]


def densely(path: np.ndarray, apart: float) -> np.ndarray:
    """A path with points at most this far apart along either axis.

    With half a pixel no pixel between two points is left out.
    """
    if len(path) < 2:
        return path
    gone = np.append(0.0, np.cumsum(np.max(np.abs(np.diff(path, axis=0)), axis=1)))
    along = np.union1d(gone, np.arange(0.0, gone[-1], apart))
    return np.column_stack([np.interp(along, gone, column) for column in path.T])


def _filled(codes: np.ndarray) -> np.ndarray:
    """Negative codes replaced by that of the nearest other pixel; 0 if there is none."""
    from scipy.ndimage import distance_transform_edt

    if not np.any(codes >= 0):
        return np.zeros_like(codes)
    missing = codes < 0
    if not np.any(missing):
        return codes
    nearest: Any = distance_transform_edt(missing, return_distances=False, return_indices=True)
    return codes[tuple(nearest)]
