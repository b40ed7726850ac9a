"""The log of a run: one row of numbers for each update, in a CSV file and in any TorchRL logger."""

import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.files import LARGEST_TABLE, read_file, whole_file, write_text
from coil_rl.output import decoration
from coil_rl.record import csv_text, curve, table
from coil_rl.report.runs import RETURN

REMEDY = "put the whole file back, or train again in another folder"  # for a damaged log


class Metrics:
    """Log of a run: its rows in memory, in a CSV file, and in any TorchRL logger.

    After a resume the rows since the checkpoint are written again. They are removed from the CSV
    file and from TensorBoard first; other loggers may show a point twice, with the same value.

    Args:
        path: of the CSV file, `metrics.csv`.
        logger: any TorchRL logger; None for the file alone.

    Attributes:
        rows: the rows so far, the first one for the state before the first update.
    """

    def __init__(self, path: Path, logger: Any | None = None) -> None:
        self.path, self.logger = path, logger
        self.rows: list[dict[str, float]] = []
        writer = getattr(logger, "experiment", None)
        self.tensorboard: Any | None = writer if hasattr(writer, "purge_step") else None

    def describe(self, settings: Mapping[str, Any]) -> None:
        """Log the configuration of the run with the TorchRL logger, if there is one.

        Args:
            settings: values by full key; numbers, flags and texts stay what they are.
        """
        plain = {
            key: value if isinstance(value, (bool, int, float, str)) else str(value)
            for key, value in settings.items()
        }
        self._tell(lambda logger: logger.log_hparams(plain))

    def close(self) -> None:
        """End the record of the TorchRL logger, so that a second run in this process has its own.

        What is logged later is lost.
        """

        def end(logger: Any) -> None:
            # Runs of MLflow end only so, and those of others too.
            leave = getattr(logger.experiment, "__exit__", None)
            if leave is None:
                logger.close()
            else:
                leave(None, None, None)

        self._tell(end)
        self.logger = None

    def append(self, row: dict[str, float]) -> None:
        """Add a row to the log; its `frames` is the step of the logger.

        The first row has all columns. What a later one lacks is NaN in it.

        Args:
            row: numbers by the names of their columns, in any order.

        Raises:
            UserError: for a name that the first row does not have.
        """
        columns = list(self.rows[0] if self.rows else row)
        new = [name for name in row if name not in columns]
        if new:
            raise UserError(
                f"{self.path} has no column {new[0]}: the first update did not return it; return "
                "the same names in each update, NaN where there is no number"
            )
        row = dict.fromkeys(columns, math.nan) | row
        self.rows.append(row)
        text, first = csv_text([row]), not self.path.exists()
        with self.path.open("a", newline="") as file:
            file.write(text if first else text.partition("\n")[2])
        self.log(row, int(row["frames"]))

    def log(self, values: Mapping[str, float], frames: int) -> None:
        """Log values with the TorchRL logger, if there is one; NaN is left out."""

        def scalars(logger: Any) -> None:
            for name, value in values.items():
                if not math.isnan(value):
                    logger.log_scalar(name, value, step=frames)

        self._tell(scalars)

    def _tell(self, use: Callable[[Any], object]) -> None:
        """Use the TorchRL logger, if there is one. One that fails is left out from then on."""
        logger, self.logger = self.logger, None
        if logger is not None:
            with decoration(f"the logger {type(logger).__name__} of {self.path.parent}"):
                use(logger)
                self.logger = logger

    def fill(self, results: Mapping[int, Mapping[str, float]]) -> None:
        """Put values into rows that were logged before, by their numbers.

        The other cells of the CSV file keep their text.
        """
        for number, values in results.items():
            self.rows[number] |= values
            self.log(values, int(self.rows[number]["frames"]))
        rows: list[dict[str, Any]] = list(table(read_file(self.path, LARGEST_TABLE)))
        for number, values in results.items():
            rows[number] |= values
        write_text(self.path, csv_text(rows))

    def newest(self) -> float | None:
        """Return the newest mean return of the curve; None if there is none yet."""
        for row in reversed(self.rows):
            value = row.get(RETURN, math.nan)
            if not math.isnan(value):
                return value
        return None

    def flush(self) -> None:
        """Wait until all rows are on the disk."""
        if self.path.exists():
            with self.path.open("a") as file:
                os.fsync(file.fileno())
        if self.tensorboard is not None and self.logger is not None:
            with decoration(f"the logger of {self.path.parent}"):
                self.tensorboard.flush()

    def truncate(self, count: int) -> None:
        """Keep only the first rows, those that belong to a checkpoint.

        Raises:
            UserError: if there are fewer rows, or the file is damaged.
        """
        self.rows = []
        with file_of_a_run(self.path, REMEDY):
            content = read_file(self.path, LARGEST_TABLE) if self.path.exists() else b""
            lines = content.splitlines(keepends=True)
            if len(lines) <= count and count:
                found = max(len(lines) - 1, 0)
                raise UserError(
                    f"{self.path} has {found} of the {count} rows that belong to the checkpoint; "
                    f"{REMEDY}"
                )
            kept = b"".join(lines[: count + 1])
            if count:
                self.rows = curve(kept)
        if count:
            with whole_file(self.path) as unfinished:
                unfinished.write_bytes(kept)
        else:
            self.path.unlink(missing_ok=True)
        self._truncate_tensorboard()

    def check_columns(self, names: list[str]) -> None:
        """Raise a `UserError` if the rows lack one of some columns."""
        for name in names:
            if self.rows and name not in self.rows[0]:
                raise UserError(f"{self.path} has no column {name}; {REMEDY}")

    def _truncate_tensorboard(self) -> None:
        if self.logger is None or self.tensorboard is None:
            return
        self.tensorboard.close()
        frames = int(self.rows[-1]["frames"]) if self.rows else 0
        writer = type(self.tensorboard)
        self.tensorboard = writer(self.tensorboard.log_dir, purge_step=frames + 1)
        self.logger.experiment = self.tensorboard
