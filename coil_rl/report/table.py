"""Tables of results as Markdown, aligned for terminals, and as CSV."""

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from itertools import chain
from numbers import Real
from typing import Any, NamedTuple, TypeGuard

import yaml

from coil_rl.files import whole_file
from coil_rl.record import csv_text, plain

# Columns and notes by table.
TABLES: Any = yaml.safe_load((resources.files("coil_rl.conf") / "tables.yaml").read_text("utf-8"))

AUTO_FORMAT = "auto"  # of a column whose unit is that of the env: as its numbers need
P_FORMAT = "p"  # of a p-value, see `p_text`

Rows = Sequence[Mapping[str, object]]
Columns = Mapping[str, Sequence[str]]
Counts = Sequence[Mapping[str, int]]


def return_format(returns: Iterable[float]) -> str:
    """Return the number format of returns of one env, of which the largest has three digits.

    At least one decimal is shown, but from 100,000 on none, and commas.

    Args:
        returns: that are shown beside each other.

    Example:
        >>> format(-36.38, return_format([-36.38])), format(0.12, return_format([0.12]))
        ('-36.4', '0.120')
    """
    largest = max((abs(each) for each in returns if math.isfinite(each)), default=0.0)
    if largest >= 100_000:
        return ",.0f"
    if largest == 0 or largest >= 10:
        return ".1f"
    # From the text, in which 9.999 is 1.00e+01.
    exponent = int(f"{largest:.2e}".partition("e")[2])
    return f".{max(1, 2 - exponent)}f" if exponent >= -4 else ".2e"


def p_text(p: float) -> str:
    """Return a p-value as a text: three decimals, or `< 0.001`."""
    return f"{p:.3f}" if p >= 0.001 else "< 0.001"


class Cell(NamedTuple):
    """A cell of a table for people.

    Attributes:
        text: as it is shown.
        number: by which rows are sorted; None for a text without a number at its start.
    """

    text: str
    number: float | None = None


class Table:
    """A table for people, in Markdown, in LaTeX or cell by cell.

    Args:
        rows: as `markdown_table` takes them.
        columns: as `markdown_table` takes them.
        counts: as `markdown_table` takes them.

    Attributes:
        headings: of the columns.
        numeric: whether each column has only numbers; none has without rows.
        cells: of each row.

    Raises:
        ValueError: if no row has a column, or a number does not fit its format.
    """

    def __init__(self, rows: Rows, columns: Columns, counts: Counts = ()) -> None:
        keys = dict.fromkeys(chain.from_iterable(rows))
        self.headings, self.numeric = list[str](), list[bool]()
        of_columns = []
        for key, (heading, spec) in columns.items():
            if rows and key not in keys:
                raise ValueError(
                    f"No row has {key!r} for the column {heading!r}; "
                    f"the rows have: {', '.join(keys)}."
                )
            values = [plain(row.get(key)) for row in rows]
            if spec == AUTO_FORMAT:
                spec = return_format(filter(_is_number, values))
            for row, count in enumerate(counts):
                if 0 < count.get(key, 0) < count["episodes"]:
                    number = _cell(values[row], spec).text
                    values[row] = f"{number} ({count[key]} of {count['episodes']})"
            self.headings.append(heading)
            are_numbers = (_is_missing(value) or _is_number(value) for value in values)
            self.numeric.append(bool(values) and all(are_numbers))
            of_columns.append([_cell(value, spec) for value in values])
        self.cells = list(map(list, zip(*of_columns, strict=True)))

    def __str__(self) -> str:
        """Return the table in Markdown; columns of numbers are right-aligned."""
        lines = [[" ".join(heading.split()) for heading in self.headings]]
        lines += [[cell.text for cell in row] for row in self.cells]
        columns, rule = [], []
        for number, is_numeric in enumerate(self.numeric):
            column = [line[number].replace("|", "\\|") for line in lines]
            width = max(map(len, column))
            columns.append([f" {text:{'>' if is_numeric else '<'}{width}} " for text in column])
            left = "-" if is_numeric or not self.cells else ":"
            rule.append(f"{left}{'-' * width}{':' if is_numeric else '-'}")
        heading, *others = zip(*columns, strict=True)
        return "\n".join(f"|{'|'.join(line)}|" for line in (heading, rule, *others))

    def latex(self) -> str:
        """Return the table as LaTeX, for the package booktabs."""
        import pandas as pd  # a training writes no LaTeX

        texts = [[cell.text for cell in row] for row in self.cells]
        alignment = "".join("r" if each else "l" for each in self.numeric)
        frame = pd.DataFrame(texts, columns=self.headings)
        text: str = frame.to_latex(index=False, escape=True, column_format=alignment)
        return text.replace("<", r"\textless ").strip()


def _cell(value: object, spec: str) -> Cell:
    if _is_missing(value):
        return Cell("-")
    if isinstance(value, bool):
        return Cell("yes" if value else "no")
    if _is_number(value):
        return Cell(p_text(value) if spec == P_FORMAT else format(value, spec), float(value))
    text = " ".join(str(value).split())
    number = re.match(r"[-+]?\d[\d,]*(\.\d+)?", text)
    return Cell(text, float(number[0].replace(",", "")) if number else None)


def markdown_table(rows: Rows, columns: Columns, counts: Counts = ()) -> str:
    """Return a Markdown table.

    Args:
        rows: one mapping per line. Missing keys, None and NaN become "-", booleans yes and no; text
            stays as it is, so a cell may be a formatted "31.2 ± 0.4".
        columns: heading (with unit) and number format by key, in the order of the table. The format
            `AUTO_FORMAT` is that of `return_format` for the column.
        counts: of each row the number of `episodes`, and by key in how many of them there is a
            number; a mean over fewer of them says so, as `12.3 (4 of 8)`.

    Raises:
        ValueError: if no row has a column, or a number does not fit its format.

    Example:
        >>> rows = [
        ...     {"policy": "guide", "lap": 31.25, "crash": False},
        ...     {"policy": "agent", "lap": None, "crash": True},
        ... ]
        >>> columns = {"policy": ("policy", ""), "lap": ("lap (s)", ".1f"), "crash": ("crash", "")}
        >>> print(markdown_table(rows, columns))
        | policy | lap (s) | crash |
        |:-------|--------:|:------|
        | guide  |    31.2 | no    |
        | agent  |       - | yes   |
    """
    return str(Table(rows, columns, counts))


def write_csv(rows: Sequence[Mapping[str, object]], path: str | os.PathLike[str]) -> None:
    """Write rows as CSV with full precision; the file appears whole or not at all.

    See `csv_text`.

    Args:
        rows: one mapping per line.
    """
    with whole_file(path) as unfinished:
        unfinished.write_text(csv_text(rows), encoding="utf-8", newline="")


def _is_missing(value: object) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, Real) and not isinstance(value, bool)
