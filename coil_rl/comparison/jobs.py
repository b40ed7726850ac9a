"""The trainings of a comparison, one after the other; one that fails leaves the others alone."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coil_rl.config.messages import reason_of
from coil_rl.config.python import Named, prepared
from coil_rl.files import FAILED_JOBS
from coil_rl.learners.learner import Callback, Learner
from coil_rl.output import decoration, progress, quietly, say
from coil_rl.run.folder import is_evaluated
from coil_rl.run.run import Run


def job_name(arm: str, seed: int) -> str:
    """Return the name of a training, and of its folder."""
    return f"{arm}_seed{seed}"


def run_jobs(jobs: Mapping[str, Named], folder: Path, frames: int) -> dict[str, str]:
    """Do the trainings that are missing; return why each of some failed, by its name.

    Args:
        jobs: what each training consists of, by its name.
    """
    failed: dict[str, str] = {}
    with progress(total=len(jobs) * frames, unit="frame", unit_scale=True, desc="compare") as bar:
        for number, (name, job) in enumerate(jobs.items(), 1):
            bar.set_description(f"{number} of {len(jobs)}, {name}")
            reason = _run_job(job, folder / name, bar)
            if reason is not None:
                failed[name] = reason
                with (folder / FAILED_JOBS).open("a", encoding="utf-8") as file:
                    file.write(f"job {name}: {reason}\n")
            bar.update(max(number * frames - bar.n, 0))
    return failed


def _run_job(job: Named, folder: Path, bar: Any) -> str | None:
    """Do one training, unless it is done; return why it failed, or None."""
    if is_evaluated(folder):
        return None
    try:
        with quietly():
            run = prepared(job, folder)
            _show(run, bar)
            run.train()
    except Exception as error:
        reason = reason_of(error)
        say(f"coil-compare: {folder.name} failed: {reason}; the others go on", error=True)
        return reason
    return None


def _show(run: Run, bar: Any) -> None:
    """Let a run tell a progress bar of its frames."""
    others = run.callbacks

    def callbacks(learner: Learner) -> list[Callback]:
        return [*others(learner), Tick(bar, run.budget.frames)]

    run.callbacks = callbacks


class Tick:
    """Tells a progress bar of the frames of a training; a `Callback`.

    Args:
        bar: of all trainings.
        frames: of this one.
    """

    names: Sequence[str] = ()

    def __init__(self, bar: Any, frames: int) -> None:
        self.bar, self.frames = bar, frames
        self.done, self.share = 0, 0.0

    def due(self, update: int, updates: int, row: Mapping[str, float]) -> bool:
        """Return whether an update is over, and note how much of the training that is."""
        self.share = update / max(updates, 1)
        return bool(row)

    def after_update(self, update: int) -> dict[str, float]:
        """Show the new frames."""
        done = int(self.frames * self.share)
        with decoration("the progress bar"):
            self.bar.update(done - self.done)
        self.done = done
        return {}
