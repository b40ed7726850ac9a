"""Tables of results as Markdown, aligned for terminals, and as CSV."""

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
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


def return_format(returns: Iterable[float]) -> str:
    """Return the number format of returns of one env, of which the largest has three digits.

    At least one decimal is shown.

    Args:
        returns: that are shown beside each other.

    Example:
        >>> format(-36.38, return_format([-36.38])), format(0.12, return_format([0.12]))
        ('-36.4', '0.120')
    """
    largest = max((abs(each) for each in returns if math.isfinite(each)), default=0.0)
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


@dataclass(frozen=True, eq=False)
class Table:
    """A table for people, in Markdown or cell by cell.

    Args:
        rows: as `markdown_table` takes them.
        columns: as `markdown_table` takes them.
    """

    rows: Rows
    columns: Columns

    def __str__(self) -> str:
        """Return the table in Markdown."""
        return markdown_table(self.rows, self.columns)

    def latex(self) -> str:
        """Return the table as LaTeX, for the package booktabs."""
        columns = "".join("r" if each else "l" for each in self.numeric)
        rows = [self.headings, *([cell.text for cell in row] for row in self.cells)]
        first, *others = (rf"{' & '.join(map(_latex, row))} \\" for row in rows)
        lines = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", first, r"\midrule"]
        return "\n".join([*lines, *others, r"\bottomrule", r"\end{tabular}"])

    @property
    def headings(self) -> list[str]:
        """Headings of the columns."""
        return [heading for heading, _ in self.columns.values()]

    @property
    def numeric(self) -> list[bool]:
        """Whether each column has only numbers; none has without rows."""
        return _numeric(_values(self.rows, self.columns)) or [False] * len(self.columns)

    @property
    def cells(self) -> list[list[Cell]]:
        """The cells of each row."""
        values = _values(self.rows, self.columns)
        specs = _specs(values, self.columns)
        return [
            [_cell(value, spec) for value, spec in zip(row, specs, strict=True)] for row in values
        ]


def _cell(value: object, spec: str) -> Cell:
    text = _format(value, spec)
    if not _is_missing(value) and _is_number(value):
        return Cell(text, float(value))
    number = re.match(r"[-+]?\d[\d,]*(\.\d+)?", text)
    return Cell(text, float(number[0].replace(",", "")) if number else None)


def markdown_table(rows: Rows, columns: Columns) -> str:
    """Return a Markdown table; columns of numbers are right-aligned.

    Args:
        rows: one mapping per line. Missing keys, None and NaN become "-", booleans yes and no; text
            stays as it is, so a cell may be a formatted "31.2 ± 0.4".
        columns: heading (with unit) and number format by key, in the order of the table. The format
            `AUTO_FORMAT` is that of `return_format` for the column.

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
    values = _values(rows, columns)
    specs = _specs(values, columns)
    lines = [[_escaped(_format(heading, "")).strip() for heading, _ in columns.values()]]
    for row in values:
        cells = zip(row, specs, strict=True)
        lines.append([_escaped(_format(value, spec)).strip() for value, spec in cells])
    right = _numeric(values) or [False] * len(columns)
    rule = []
    for column, numbers in enumerate(right):
        width = max(len(line[column]) for line in lines)
        for line in lines:
            line[column] = f" {line[column]:{'>' if numbers else '<'}{width}} "
        rule.append(f"{'-' * (width + 1)}:" if numbers else f":{'-' * (width + 1)}")
    if not values:
        rule = ["-" * len(cell) for cell in lines[0]]
    return "\n".join(f"|{'|'.join(line)}|" for line in (lines[0], rule, *lines[1:]))


def fitted(rows: Rows, columns: Columns) -> dict[str, tuple[str, str]]:
    """Return columns with a number format in place of each `AUTO_FORMAT`.

    Args:
        columns: as `markdown_table` takes them.
    """
    specs = _specs(_values(rows, columns), columns)
    headings = ((name, heading) for name, (heading, _) in columns.items())
    return {name: (heading, spec) for (name, heading), spec in zip(headings, specs, strict=True)}


def _values(rows: Rows, columns: Columns) -> list[list[object]]:
    """Return the values of each row in the order of the columns."""
    keys = dict.fromkeys(chain.from_iterable(rows))
    for key, (heading, _) in columns.items():
        if rows and key not in keys:
            raise ValueError(
                f"No row has {key!r} for the column {heading!r}; the rows have: {', '.join(keys)}."
            )
    return [[plain(row.get(key)) for key in columns] for row in rows]


def _specs(values: Sequence[Sequence[object]], columns: Columns) -> list[str]:
    """Return the number format of each column, given the values of each row."""
    specs = [spec for _, spec in columns.values()]
    for index, spec in enumerate(specs):
        if spec == AUTO_FORMAT:
            column = [row[index] for row in values]
            specs[index] = return_format(float(each) for each in column if _is_number(each))
    return specs


def _numeric(values: Sequence[Sequence[object]]) -> list[bool]:
    """Return whether each column has only numbers, given the values of each row."""
    return [
        all(_is_missing(value) or _is_number(value) for value in column)
        for column in zip(*values, strict=True)
    ]


def _latex(text: str) -> str:
    """Return a text as LaTeX shows it."""
    escaped = re.sub(r"([&%$#_{}])", r"\\\1", text.replace("\\", r"\textbackslash "))
    escaped = escaped.replace("~", r"\textasciitilde ").replace("^", r"\textasciicircum ")
    return escaped.replace("<", r"\textless ")


def _escaped(text: str) -> str:
    return text.replace("|", "\\|")


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


def _format(value: object, spec: str) -> str:
    if _is_missing(value):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if _is_number(value):
        return p_text(value) if spec == P_FORMAT else format(value, spec)
    return " ".join(str(value).split())
