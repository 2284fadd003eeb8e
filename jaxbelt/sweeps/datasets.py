"""Datasets of sweeps: variables with names, units and meanings, and the results in memory.

A category is an integer; its meaning is in the attributes `flag_values` and `flag_meanings` of the
CF conventions, and `decoded` puts the words in its place.
"""

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..checks import require_value
from ..kernel.lanes import Program, Variable
from ..results import Status
from .grid import Blocks, Grid
from .queue import by_name, layout

if TYPE_CHECKING:
    import xarray

#: Dimensions of the axes of starts.
DIMENSIONS_OF_STARTS = {"x1": "length", "x2": "velocity"}
#: Long names of axes; other arguments of `make` go by their own name.
AXIS_NAMES = {
    "nu0": "velocity of belt 0",
    "nu1": "velocity of belt 1",
    "sigma": "edge between the contact intervals",
    "sigma0": "lower edge of belt 1's contact interval",
    "sigma1": "upper edge of belt 0's contact interval",
    "x1": "displacement at the start",
    "x2": "velocity at the start",
    "belt": "belt",
}
STATUS = Variable(
    "how the run ended, a jaxbelt.Status",
    "int8",
    meanings={status.value: status.name.lower() for status in Status},
)
#: Status of runs that are not done yet, and the word for them in every category.
NOT_RUN = -1
NOT_DONE = "not_done"
#: Names that a store needs for its own arrays.
TAKEN = ("ledger",)


def decoded(dataset: "xarray.Dataset") -> "xarray.Dataset":
    """Replaces the integers of categories by words.

    Every variable with the attributes `flag_values` and `flag_meanings` becomes one of strings, so
    that `decoded(dataset).kind == "cycle"` works as it reads. An integer without a meaning becomes
    ""; in a store whose sweep is not finished, runs that are not done are "not_done".

    Args:
        dataset: From `sweep`, or `Basins.dataset`, also as read from a file.

    Returns:
        The dataset with words.

    Raises:
        ValueError: If it is no dataset.
    """
    check_dataset(dataset)
    return dataset.assign(
        {
            name: variable.copy(data=words_of(variable.values, variable.attrs)).drop_attrs()
            for name, variable in dataset.items()
            if "flag_meanings" in variable.attrs
        }
    )


def check_dataset(dataset: Any) -> None:
    """Raises a `ValueError` unless `dataset` is, or behaves like, an `xarray.Dataset`."""
    fits = all(hasattr(dataset, name) for name in ("data_vars", "dims", "assign"))
    require_value(fits, "dataset", "an xarray.Dataset, such as sweep(...) returns", dataset)


def words_of(values: np.ndarray, attributes: dict[str, Any]) -> np.ndarray:
    """Words that the values of a category stand for."""
    numbers = np.atleast_1d(attributes["flag_values"])
    words = np.array(["", *attributes["flag_meanings"].split()])
    order = np.argsort(numbers)
    place = order[np.searchsorted(numbers, values, sorter=order).clip(max=len(order) - 1)]
    return np.asarray(words[np.where(numbers[place] == values, place + 1, 0)])


def variable_of(
    name: str, described: Mapping[str, Variable], derivatives: Iterable[str]
) -> Variable:
    """Description of a variable: an observer's own, a derivative of one, or else its name only.

    The dimension of a derivative is "velocity / length", say, or "length / unit of nu0".
    """
    if name in described:
        return described[name]
    for by in derivatives:
        of = name.removeprefix("d_").removesuffix(f"_d_{by}")
        if name == f"d_{of}_d_{by}":
            known = described.get(of, Variable(of))
            per = DIMENSIONS_OF_STARTS.get(by, f"unit of {by}")
            dimension = f"{known.dimension} / {per}" if known.dimension else None
            words = f"derivative of {of} by {by}"
            return Variable(words, per_belt=known.per_belt, dimension=dimension)
    return Variable(name)


def flags(meanings: Mapping[int, str], dtype: str) -> dict[str, Any]:
    """Attributes of a category by the CF conventions: its values and their words."""
    return {
        "flag_values": np.array(list(meanings), dtype),
        "flag_meanings": " ".join(name.replace(" ", "_") for name in meanings.values()),
    }


def _not_done(meanings: Mapping[int, str]) -> int:
    """Value of a category in runs that are not done: below all others, and below 0."""
    return min(0, *meanings) + NOT_RUN


class Table:
    """The variables of a sweep: their order, shapes, types and attributes.

    layout: shapes of the kernel's results of one run, by name; shapes: the same for all variables,
    derivatives among them.
    """

    def __init__(self, program: Program, grid: Grid, derivatives: tuple[str, ...]):
        self.grid, self.derivatives = grid, derivatives
        self.layout = layout(program, grid.shared)
        self.described = {**program.observer.variables, "status": STATUS}
        names = [name for name in self.described if name in self.layout]
        names += [name for name in self.layout if name not in names]
        self.shapes = {name: self.layout[name] for name in names}
        for by in derivatives:
            for name in names:
                if np.issubdtype(self.variable(name).dtype, np.floating):
                    self.shapes[f"d_{name}_d_{by}"] = self.layout[name]

    def check_names(self) -> None:
        """Raises a `ValueError` for a bad name.

        Two things in the dataset may not have one name, and stores reserve some names.
        """
        axes, results = [*self.grid.axes], [*self.shapes]
        dimensions = {name for result in results for name in self.dims(result)[len(axes) :]}
        others = "a dimension, or ledger, and without /"
        for name in axes:
            taken = {*results, *dimensions, *TAKEN}
            expected = f"named otherwise than a result, {others}"
            require_value(name not in taken and "/" not in name, "axes", expected, name)
        for name in results:
            expected = f"an observable whose results are named otherwise than {others}"
            taken = {*dimensions, *TAKEN}
            require_value(name not in taken and "/" not in name, "observe", expected, name)

    def variable(self, name: str) -> Variable:
        """Description of a variable."""
        return variable_of(name, self.described, self.derivatives)

    def empty(self, name: str) -> Any:
        """Placeholder for the results of runs that are not done."""
        variable = self.variable(name)
        dtype = np.dtype(variable.dtype)
        return dtype.type(_not_done(variable.meanings) if variable.meanings else 0)

    def parts(self, results: np.ndarray) -> dict[str, np.ndarray]:
        """Variables of runs, [runs, ...], from results [1 + derivatives, columns, runs]."""
        values = by_name(self.layout, results)
        found = {}
        for name in self.shapes:
            if name in values:
                part, dtype = values[name][0], np.dtype(self.variable(name).dtype)
                # Codes of runs that are not finite are NaN; these become 0.
                exact = not np.issubdtype(dtype, np.floating)
                found[name] = (np.nan_to_num(part) if exact else part).astype(dtype)
        for i, by in enumerate(self.derivatives):
            found |= {
                # Where the value is NaN the kernel returns the derivative of a constant, 0.
                f"d_{name}_d_{by}": np.where(np.isfinite(of[0]), of[i + 1], np.nan)
                for name, of in values.items()
                if f"d_{name}_d_{by}" in self.shapes
            }
        return found

    def dims(self, name: str) -> tuple[str, ...]:
        """Dimensions of a variable."""
        extra = [f"{name}_{i}" for i in range(len(self.shapes[name]))]
        if self.variable(name).per_belt:
            extra = ["belt"]
        return (*self.grid.axes, *extra)

    def attributes(self, name: str) -> dict[str, Any]:
        """Attributes of a variable; `numbering` adds those of categories that are numbered."""
        variable = self.variable(name)
        attributes: dict[str, Any] = {"long_name": variable.long_name}
        if variable.dimension:
            attributes["quantity"] = variable.dimension
        if variable.meanings:
            meanings = {_not_done(variable.meanings): NOT_DONE, **variable.meanings}
            attributes |= flags(meanings, variable.dtype)
        return attributes

    def coordinates(self) -> dict[str, tuple[str, np.ndarray, dict[str, str]]]:
        """Coordinates of the dataset."""
        axes = dict(self.grid.axes)
        if any("belt" in self.dims(name) for name in self.shapes):
            axes["belt"] = np.arange(len(self.grid.example.belts))
        attributes = {name: {"long_name": AXIS_NAMES.get(name, name)} for name in axes}
        for name in DIMENSIONS_OF_STARTS.keys() & axes.keys():
            attributes[name]["quantity"] = DIMENSIONS_OF_STARTS[name]
        return {name: (name, values, attributes[name]) for name, values in axes.items()}

    def numbered(self) -> list[str]:
        """Variables whose categories are numbered when all runs are done."""
        return [name for name in self.shapes if self.variable(name).name_of is not None]

    @property
    def nbytes(self) -> int:
        """Size of the dataset in memory, in bytes."""
        numbered, width = self.numbered(), 0
        for name, shape in self.shapes.items():
            dtype = NUMBERED if name in numbered else self.variable(name).dtype
            width += math.prod(shape) * np.dtype(dtype).itemsize
        coordinates = self.coordinates().values()
        return self.grid.runs * width + sum(values.nbytes for _, values, _ in coordinates)

    def numbering(self, name: str, codes: Iterable[int]) -> tuple[dict[int, int], dict[str, Any]]:
        """Numbers of the categories with these codes, and the attributes that name them."""
        name_of = self.variable(name).name_of
        assert name_of is not None
        belts = len(self.grid.example.belts)
        return numbered({code: name_of(code, belts) for code in codes})


#: Names of categories that get the first numbers.
FIRST_NAMES = ("none", "smooth")
#: Integer type of the numbers of such categories.
NUMBERED = "int16"


def numbered(names: Mapping[int, str]) -> tuple[dict[int, int], dict[str, Any]]:
    """A number for each code, in the order of the names, and the attributes that name them."""
    ordered = sorted(set(names.values()), key=_rank_of)
    number = {name: i for i, name in enumerate(ordered)}
    numbers = {code: number[name] for code, name in names.items()}
    return numbers, flags(dict(enumerate(ordered)), NUMBERED)


def _rank_of(name: str) -> tuple[Any, ...]:
    return *(name != first for first in FIRST_NAMES), name


def renumber(codes: np.ndarray, numbers: dict[int, int]) -> np.ndarray:
    """Replaces codes of categories by their numbers, an array of the same shape."""
    different, place = np.unique(codes, return_inverse=True)
    return np.array([numbers[int(code)] for code in different], NUMBERED)[place].reshape(
        codes.shape
    )


class Memory:
    """Results of a sweep in memory; `Store` has the same methods for results in a folder."""

    def __init__(self, table: Table):
        self.table, self.runs = table, table.grid.runs
        self.blocks, self.to_do = Blocks(table.grid.shape, self.runs), [0]
        self.arrays = {
            name: np.full((self.runs, *shape), table.empty(name), table.variable(name).dtype)
            for name, shape in table.shapes.items()
        }

    def put(self, block: int, positions: np.ndarray, results: np.ndarray) -> None:
        """Keeps the results of the runs at some positions in a block."""
        for name, part in self.table.parts(results).items():
            self.arrays[name][positions] = part

    def of_runs(self, runs: np.ndarray) -> dict[str, np.ndarray]:
        """The kernel's results for some runs."""
        return {name: self.arrays[name][runs] for name in self.table.layout}

    def done(self) -> int:
        """Number of runs that are done."""
        return int(np.sum(self.arrays["status"] != NOT_RUN))

    def interrupted(self) -> str:
        """Says what becomes of the results of an interrupted sweep."""
        return (
            f"interrupted after {self.done():,} of {self.runs:,} runs, which are not kept; a sweep "
            'with a store (store="results.zarr", `jaxbelt sweep ... --out results.zarr`) keeps '
            "them, and the same call goes on from there"
        )

    def dataset(self, attributes: dict[str, Any]) -> "xarray.Dataset":
        """The labelled results."""
        import xarray  # late: with pandas, half the time of `import jaxbelt`

        table, variables = self.table, {}
        numbered = table.numbered()
        for name in table.shapes:
            values, own = self.arrays[name], table.attributes(name)
            if name in numbered:
                numbers, named = table.numbering(name, np.unique(values).tolist())
                values, own = renumber(values, numbers), own | named
            values = values.reshape(*table.grid.shape, *values.shape[1:])
            variables[name] = (table.dims(name), values, own)
        return xarray.Dataset(variables, table.coordinates(), attributes)
