"""The trainings of a comparison, one after the other; one that fails leaves the others alone."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coil_rl.config.messages import reason_of
from coil_rl.config.python import Named, prepared
from coil_rl.files import FAILED_JOBS
from coil_rl.output import decoration, progress, quietly, say
from coil_rl.run.folder import is_evaluated

BAR = "compare, {desc}{percentage:3.0f}%|{bar}| {elapsed}<{remaining}"  # in trainings


def job_name(arm: str, seed: int | str) -> str:
    """Return the name of a training, and of its folder; of all seeds for the seed `*`."""
    return f"{arm}_seed{seed}"


def run_jobs(jobs: Mapping[str, Named], folder: Path) -> dict[str, str]:
    """Do the trainings that are missing; return why each of some failed, by its name.

    Args:
        jobs: what each training consists of, by its name.
    """
    failed: dict[str, str] = {}
    with progress(total=len(jobs), bar_format=BAR) as bar:
        for number, (name, job) in enumerate(jobs.items(), 1):
            bar.set_description(f"{number} of {len(jobs)}, {name}")
            reason = _run_job(job, folder / name, bar)
            if reason is not None:
                failed[name] = reason
                with (folder / FAILED_JOBS).open("a", encoding="utf-8") as file:
                    file.write(f"job {name}: {reason}\n")
            show_progress(bar, number)
    return failed


def _run_job(job: Named, folder: Path, bar: Any) -> str | None:
    """Do one training, unless it is done; return why it failed, or None."""
    if is_evaluated(folder):
        return None
    try:
        with quietly():
            run = prepared(job, folder)
            others = run.callbacks
            run.callbacks = lambda learner: [*others(learner), Tick(bar)]
            run.train()
    except Exception as error:
        reason = reason_of(error)
        say(f"coil-compare: {folder.name} failed: {reason}; the others go on", error=True)
        return reason
    return None


def show_progress(bar: Any, done: float) -> None:
    """Set a bar to what is done; a sum of increments could be rounded above its total."""
    bar.n = done
    bar.update(0)


class Tick:
    """Tells a progress bar of the share of a training that is done; a `Callback`.

    Args:
        bar: of all trainings.
    """

    names: Sequence[str] = ()

    def __init__(self, bar: Any) -> None:
        self.bar, self.begun, self.share = bar, bar.n, 0.0

    def due(self, update: int, updates: int, row: Mapping[str, float]) -> bool:
        """Return whether an update is over, and note how much of the training that is."""
        self.share = update / max(updates, 1)
        return bool(row)

    def after_update(self, update: int) -> dict[str, float]:
        """Show the new share."""
        with decoration("the progress bar"):
            show_progress(self.bar, self.begun + self.share)
        return {}
