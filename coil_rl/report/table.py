"""Tables of results: Markdown that also reads well in a terminal, and CSV for other programs."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping, Sequence
from numbers import Real

from coil_rl.files import whole_file

MISSING = "-"


def markdown_table(rows: Sequence[Mapping[str, object]], columns: Mapping[str, tuple[str, str]]) -> str:
    """A Markdown table, padded so that its columns line up in a terminal as well.

    Args:
        rows: one mapping a line; what a row lacks, None and NaN become "-", truth values become yes and no, and text is
            taken as it is, so that a cell may also be a ready "31.2 ± 0.4".
        columns: from key to heading (with the unit) and format of its numbers, in the order of the table.

    Returns:
        The lines of the table, without a line break at the end. Columns of numbers are aligned to the right.

    Raises:
        ValueError: if no row has a key of `columns`, or a number does not take its column's format.

    Example:
        >>> rows = [{"driver": "guide", "lap": 31.25, "crash": False}, {"driver": "agent", "lap": None, "crash": True}]
        >>> print(markdown_table(rows, {"driver": ("driver", ""), "lap": ("lap (s)", ".1f"), "crash": ("crash", "")}))
        | driver | lap (s) | crash |
        | :----- | ------: | :---- |
        | guide  |    31.2 | no    |
        | agent  |       - | yes   |
    """
    known = list(dict.fromkeys(key for row in rows for key in row))
    cells: list[list[str]] = []
    for key, (heading, spec) in columns.items():
        if rows and key not in known:
            raise ValueError(
                f"No row has {key!r} for the column {heading!r}; the rows have: {', '.join(known) or 'nothing'}."
            )
        cells.append([_cell(heading, ""), *(_cell(row.get(key), spec, key) for row in rows)])
    # A number or a gap aligns right; text and truth values are read from the left.
    right = [bool(rows) and all(_is_numeric(row.get(key)) for row in rows) for key in columns]
    widths = [max(3, *map(len, column)) for column in cells]
    rule = [("-" * (w - 1) + ":") if r else (":" + "-" * (w - 1)) for w, r in zip(widths, right, strict=True)]
    lines = [
        [cell.rjust(w) if r else cell.ljust(w) for cell, w, r in zip(line, widths, right, strict=True)]
        for line in zip(*cells, strict=True)
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in [*lines[:1], rule, *lines[1:]])


def write_csv(rows: Sequence[Mapping[str, object]], path: str | os.PathLike[str]) -> None:
    """Write rows as CSV with full precision: the file appears whole or not at all.

    Args:
        rows: one mapping a line; the columns are all their keys in the order in which they first appear. What a row
            lacks and None become an empty cell, NaN becomes nan.
        path: the file; its folder is made.
    """
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with whole_file(path) as unfinished, unfinished.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        if columns:
            writer.writeheader()
        writer.writerows({key: _plain(value) for key, value in row.items()} for row in rows)


def _plain(value: object) -> object:
    """A NumPy or torch scalar as the Python number it holds; anything else as it is."""
    if getattr(value, "ndim", None) == 0 and hasattr(value, "item"):
        number: object = value.item()
        return number
    return value


def _is_missing(value: object) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def _is_numeric(value: object) -> bool:
    value = _plain(value)
    return _is_missing(value) or (isinstance(value, Real) and not isinstance(value, bool))


def _cell(value: object, spec: str, key: str = "") -> str:
    value = _plain(value)
    if _is_missing(value):
        return MISSING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Real):
        try:
            return format(value, spec)
        except ValueError as error:
            raise ValueError(
                f"The column {key!r} holds {value!r}, which does not take the format {spec!r}: {error}."
            ) from None
    return " ".join(str(value).split()).replace("|", "\\|")
