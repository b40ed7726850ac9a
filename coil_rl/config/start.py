"""One run of a configuration, new or begun before."""

from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig

from coil_rl.config.build import assemble
from coil_rl.config.saved import holds
from coil_rl.run.folder import locked


def run_configured(
    config: DictConfig,
    *,
    wait: bool = False,
    command: Sequence[str] = (),
) -> float:
    """Do a run, or finish it if `existing=resume`; return the mean test reward of its policy.

    Args:
        config: of `coil-train`, composed.
        wait: whether to wait for another process that uses the folder.
        command: what was typed, for the folder of the run.

    Raises:
        UserError: for a folder that holds another run, or that another process uses.
    """
    run = assemble(config)
    run.command = command
    folder = Path(config.run_dir)
    with locked(folder, wait=wait):
        if config.existing == "resume" and holds(folder, config):
            return run.finish_begun()
        run.begin()
        return run.finish()
