"""The folder of a run as a typed record: what each file holds, read and written in one way.

A folder may come from anybody. A file is read with a limit of its size and without running code,
and its content has the type that is declared here. One that is missing is None; one that is damaged
is a sentence with its name, what is wrong, and what to do.
"""

import csv
import io
import json
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.files import LARGEST_NUMBERS, LARGEST_TABLE, read_file, write_text

T = TypeVar("T")
Row = dict[str, Any]  # of a table

MOST_MEANS = 50_000  # rows of an evaluation that a report can be made of
MOST_DRIVERS = 200  # in it, with all kinds of advice and actions
DRIVER = ("driver", "advice", "actions", "case")  # columns of the tables of episodes: texts
UNTESTED = "last_untested"  # in `Delivery`: the last policy, as no frames were left for a test


@dataclass(frozen=True)
class File(Generic[T]):
    """A file of a run.

    Args:
        name: in the folder.
        parse: returns the content of its bytes.
        remedy: what to do where it is damaged, the end of a sentence; `{folder}` is the run's.
        largest: allowed size, in bytes.
        text_of: returns the text of a content.
    """

    name: str
    parse: Callable[[bytes], T]
    remedy: str
    largest: int = LARGEST_NUMBERS
    text_of: Callable[[T], str] = str

    def read(self, folder: Path) -> T | None:
        """Return the content in the folder of a run; None without the file.

        Raises:
            UserError: for a file that is damaged, or larger than any of its kind.
        """
        path = folder / self.name
        if not path.exists():
            return None
        with file_of_a_run(path, self.remedy.format(folder=shlex.quote(str(folder)))):
            return self.parse(read_file(path, self.largest))

    def need(self, folder: Path) -> T:
        """Return the content in the folder of a run.

        Raises:
            UserError: as `read`, and for a missing file.
        """
        content = self.read(folder)
        if content is None:
            raise UserError(
                f"there is no file {folder / self.name}; put back what coil-train wrote, or run it"
            )
        return content

    def write(self, folder: Path, content: T) -> None:
        """Write the content into the folder of a run, complete or not at all."""
        write_text(folder / self.name, self.text_of(content))


def json_file(name: str, kind: type[T], remedy: str) -> File[T]:
    """Return a file of JSON with the values of a type, such as a model of pydantic.

    Args:
        name: as of `File`.
        remedy: as of `File`.
    """
    adapter = TypeAdapter(kind)

    def parse(content: bytes) -> T:
        try:
            return adapter.validate_json(content)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"]))
            raise ValueError(": ".join(filter(None, (where, first["msg"])))) from error

    def text_of(content: T) -> str:
        return json.dumps(adapter.dump_python(content), indent=2)

    return File(name, parse, remedy, text_of=text_of)


def table(content: bytes) -> list[dict[str, str]]:
    """Return the rows of a CSV file by the names of its columns, all cells as text.

    So numbers keep every digit, and an empty cell is an error where a number is expected.

    Raises:
        ValueError: for what is no text or empty, and for a row with more values than there are
            columns; one with fewer, as while it is written, is filled with "nan".
    """
    try:
        lines = list(csv.reader(io.StringIO(content.decode("utf-8"), newline=""), strict=True))
    except csv.Error as error:
        raise ValueError(str(error)) from error
    if not lines or not lines[0]:
        raise ValueError("No columns")
    columns = lines[0]
    if len(set(columns)) < len(columns):
        raise ValueError("two columns of one name")
    rows = [line for line in lines[1:] if line]
    if any(len(row) > len(columns) for row in rows):
        raise ValueError("a row with more values than columns")
    return [dict(zip_longest(columns, row, fillvalue="nan")) for row in rows]


def curve(content: bytes) -> list[dict[str, float]]:
    """Return the rows of a log.

    Raises:
        ValueError: if a cell is no number, or `frames` is missing.
    """
    rows = [{name: float(cell) for name, cell in row.items()} for row in table(content)]
    if not all(math.isfinite(row.get("frames", math.nan)) for row in rows):
        raise ValueError("not every row has its number of frames")
    return rows


def means(content: bytes) -> list[Row]:
    """Return the rows of an evaluation: the columns `DRIVER` are texts, all others numbers.

    Raises:
        ValueError: for two rows of one driver in the same case, for a return that is infinite, for
            more than `MOST_MEANS` rows or `MOST_DRIVERS` drivers, and for none.
    """
    rows: list[Row] = []
    for line in table(content):
        cells = {name: line[name] for name in DRIVER} | {"reward": float(line["reward"])}
        rows.append(cells | {name: float(line[name]) for name in line if name not in cells})
    if not 0 < len(rows) <= MOST_MEANS:
        raise ValueError(f"{len(rows):,} rows, not 1 to {MOST_MEANS:,}")
    drivers = len({tuple(row[name] for name in DRIVER[:3]) for row in rows})
    if drivers > MOST_DRIVERS:
        raise ValueError(f"{drivers:,} drivers, not 1 to {MOST_DRIVERS}")
    if any(math.isinf(row["reward"]) for row in rows):
        raise ValueError("a return that is infinite")
    if len({tuple(row[name] for name in DRIVER) for row in rows}) < len(rows):
        raise ValueError("two rows of one driver in the same case")
    return rows


def csv_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows as CSV with full precision.

    The columns are all keys in the order of their first appearance. Missing keys and None become an
    empty cell, NaN becomes nan.
    """
    columns, text = list(dict.fromkeys(chain.from_iterable(rows))), io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    if columns:
        writer.writeheader()
    writer.writerows({key: plain(value) for key, value in row.items()} for row in rows)
    return text.getvalue()


def plain(value: object) -> object:
    """Return the Python number of a NumPy or torch scalar, and anything else as it is."""
    if getattr(value, "ndim", None) == 0 and hasattr(value, "item"):
        return value.item()
    return value


class Delivery(BaseModel):
    """Which policy a run hands over, and why.

    Attributes:
        policy: "last", "earlier", "first", `UNTESTED`, "tuned", "best_candidate", or the title of
            a guide.
        cases: number of cases of the test.
        steps: of all tests of the run.
        calls: number of actions that a search asked its guide for.
        returns: mean returns by policy.
        ahead: of the last policy: mean difference, and the ends of its 95 % t interval.
        frames: after which an earlier policy was kept.
    """

    model_config = ConfigDict(frozen=True)

    policy: str
    cases: int
    steps: int = 0
    calls: int = 0
    returns: dict[str, float]
    ahead: tuple[float, float, float] | None = None
    frames: int | None = None


def _text(content: bytes) -> str:
    return content.decode("utf-8-sig").strip()


def _words(content: bytes) -> list[str]:
    """Return the words of a command, as a shell reads them."""
    return shlex.split(_text(content))


PUT_BACK = "put the file back that coil-train wrote, or leave this run out"
AGAIN = "remove the file and write it again by coil-train resume={folder}"
COMMAND = File("command.txt", _words, "remove it", text_of=shlex.join)
VERSIONS = json_file("versions.json", dict[str, str], "remove it")
METRICS = File("metrics.csv", curve, PUT_BACK, LARGEST_TABLE)
EPISODES = File("episodes.csv", table, AGAIN, LARGEST_TABLE, csv_text)
EVALUATION = File("evaluation.csv", means, AGAIN, LARGEST_TABLE, csv_text)
PAGE = File("evaluation.md", _text, AGAIN)
TUNED = json_file("tuned.json", dict[str, float], PUT_BACK)  # numbers of the guide
DELIVERY = json_file("delivery.json", Delivery, "remove it, and the sentence is left out")
GUIDE_RETURNS = json_file(
    "guide_return.json", dict[str, float], "remove it, and the run measures it again"
)
SECONDS = json_file("training_time.json", dict[str, float], "remove it, and no time is shown")
