"""A run that is refused: one sentence, exit code 2, and no trace of it on the disk."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any, ClassVar, NoReturn

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from coil_rl.errors import UserError
from coil_rl.sentence import sentence


class Refusal(Callback):
    """Hydra makes the folder of a run before it starts the program; only its callbacks can tell which folders are new.

    Attributes:
        new: of the run or the sweep at hand, the innermost first. Hydra keeps the callback itself out of reach.
    """

    new: ClassVar[list[Path]] = []

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note which folders are not there yet."""
        self._note(config, "hydra.run.dir")

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note which folders are not there yet."""
        self._note(config, "hydra.sweep.dir")

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note the folder of this job of a sweep."""
        folder = Path(config.hydra.runtime.output_dir)
        if folder.parent in self.new and folder not in self.new:
            self.new.insert(0, folder)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Refuse, if that is how the program ended; later Hydra would put a line of its own before the sentence."""
        error = job_return._return_value
        if job_return.status == JobStatus.FAILED and isinstance(error, (UserError, OmegaConfBaseException)):
            refuse(config.hydra.job.name, error)

    def on_run_end(self, config: DictConfig, **kwargs: Any) -> None:
        """From here on the folders are the run's."""
        self.new.clear()

    on_multirun_end = on_run_end

    def _note(self, config: DictConfig, key: str) -> None:
        try:
            folder = Path(str(OmegaConf.select(config, key))).absolute()
        except OmegaConfBaseException:
            return  # Hydra is about to say so
        self.new[:] = [place for place in (folder, *folder.parents) if not place.exists()]


def refuse(program: str, error: Exception) -> NoReturn:
    """End the program with one sentence on standard error, and take new folders away unless something is in them."""
    for folder in Refusal.new:
        if folder.is_dir() and {item.name for item in folder.iterdir()} <= {".hydra", "multirun.yaml"}:
            shutil.rmtree(folder, ignore_errors=True)
    Refusal.new.clear()
    print(f"{program}: {sentence(error)}", file=sys.stderr)
    sys.exit(2)
