"""The log of a run: one row an update."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import Any

from coil_rl.errors import UserError
from coil_rl.files import whole_file


class Metrics:
    """Writes each row to a CSV file and to a TorchRL logger.

    A run that goes on after a checkpoint writes again what came after it. From the CSV file those rows are removed, and
    TensorBoard is told to forget its points. Other loggers have no such means: they may show a point twice, with the
    same value.

    Args:
        path: of the CSV file.
        logger: any TorchRL logger.
    """

    def __init__(self, path: Path, logger: Any | None = None) -> None:
        self.path, self.logger = path, logger
        writer = getattr(logger, "experiment", None)
        self.tensorboard: Any | None = writer if hasattr(writer, "purge_step") else None

    def append(self, row: dict[str, float]) -> None:
        """Log a row; its `frames` are the logger's step."""
        first = not self.path.exists()
        with self.path.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if first:
                writer.writeheader()
            writer.writerow(row)
        if self.logger is not None:
            for name, value in row.items():
                self.logger.log_scalar(name, value, step=int(row["frames"]))

    def flush(self) -> None:
        """Wait until all rows are on the disk: a checkpoint may then rely on them."""
        if self.path.exists():
            with self.path.open("a") as file:
                os.fsync(file.fileno())
        if self.tensorboard is not None:
            self.tensorboard.flush()

    def keep(self, count: int) -> list[dict[str, float]]:
        """Forget all but the first rows.

        Raises:
            UserError: if there are not so many.
        """
        lines = self.path.read_bytes().splitlines(keepends=True) if self.path.exists() else []
        if len(lines) <= count and count:
            raise UserError(
                f"{self.path} has {max(len(lines) - 1, 0)} of the {count} rows that belong to the checkpoint; "
                "put the whole file back, or train again in another folder"
            )
        rows: list[dict[str, float]] = []
        if count:
            with whole_file(self.path) as unfinished:
                unfinished.write_bytes(b"".join(lines[: count + 1]))
            with self.path.open(newline="") as file:
                rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
        else:
            self.path.unlink(missing_ok=True)
        if self.logger is not None and self.tensorboard is not None:
            self.tensorboard.close()
            frames = int(rows[-1]["frames"]) if rows else 0
            self.tensorboard = type(self.tensorboard)(self.tensorboard.log_dir, purge_step=frames + 1)
            self.logger.experiment = self.tensorboard
        return rows
