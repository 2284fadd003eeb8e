"""Tables of numbers as CSV files, every number to the last digit."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def write_table(table: Any, path: Path) -> None:
    """Writes a table of a result."""
    table.to_csv(path, index=False, na_rep="nan")


def write_columns(columns: Mapping[str, Any], path: Path) -> None:
    """Writes columns of equal length, by name."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        lists = (one.tolist() if hasattr(one, "tolist") else one for one in columns.values())
        writer.writerows(zip(*lists, strict=True))


def in_columns(dataset: Any, names: Sequence[str]) -> dict[str, Any]:
    """Variables of a dataset in SI units as columns, whose names have the units: "x2 (m/s)"."""
    units = {name: dataset[name].attrs.get("units", "") for name in names}
    return {headed(name, unit): dataset[name].values for name, unit in units.items()}


def headed(name: str, unit: str) -> str:
    """Heading of a column: "x2 (m/s)" for the name x2 and the unit "m s-1"."""
    from ..plotting.style import in_fractions

    return f"{name} ({in_fractions(unit).replace('$', '')})" if unit not in ("", "1") else name
