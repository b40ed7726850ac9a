"""One run of a configuration, new or begun before."""

from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig

from coil_rl.config.build import assemble
from coil_rl.config.saved import holds
from coil_rl.learners.learner import Callback, Learner
from coil_rl.run.folder import locked
from coil_rl.run.run import Run


def run_configured(
    config: DictConfig,
    *,
    wait: bool = False,
    command: Sequence[str] = (),
    callback: Callback | None = None,
) -> float:
    """Do a run, or finish it if `existing=resume`; return the mean test reward of its policy.

    Args:
        config: of `coil-train`, composed.
        wait: whether to wait for another process that uses the folder.
        command: what was typed, for the folder of the run.
        callback: a further one of the training.

    Raises:
        UserError: for a folder that holds another run, or that another process uses.
    """
    run = assemble(config)
    run.command = command
    if callback is not None:
        _add(run, callback)
    folder = Path(config.run_dir)
    with locked(folder, wait=wait):
        if config.existing == "resume" and holds(folder, config):
            return run.finish_begun()
        run.begin()
        return run.finish()


def _add(run: Run, callback: Callback) -> None:
    """Add a callback to those of a run."""
    others = run.callbacks

    def callbacks(learner: Learner) -> list[Callback]:
        return [*others(learner), callback]

    run.callbacks = callbacks
