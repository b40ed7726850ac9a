"""`coil-train`: train a method, evaluate the policy beside its guides and draw the results."""

from __future__ import annotations

import sys
from pathlib import Path

from omegaconf import DictConfig

from coil_rl.errors import UserError
from coil_rl.programs import app


def train(config: DictConfig) -> float:
    """Do one run and return the mean test reward of its deterministic policy."""
    from coil_rl.train.run import run

    if config.resume is not None:
        raise UserError(f"resume={config.resume} belongs on the command line, alone: coil-train resume=FOLDER")
    return run(config)


def resume(folder: Path) -> float:
    """Finish a run that was stopped, and return the same as `train`.

    Raises:
        UserError: if the folder holds no run, or one that cannot be resumed.
    """
    from coil_rl.train.check import check
    from coil_rl.train.run import resume_run
    from coil_rl.train.run_folder import is_evaluated, locked, read_config

    config = read_config(folder, "resume")
    folder = folder.absolute()
    config.run_dir = str(folder)
    with locked(folder):
        try:
            if not is_evaluated(folder):
                check(config)
        except UserError as error:
            raise UserError(f"{folder / 'config.yaml'}: {error}") from error
        return resume_run(config, folder)


def main() -> None:
    """Entry point."""
    arguments = sys.argv[1:]
    resumed = next((argument for argument in arguments if argument.startswith("resume=")), None)
    if resumed is None:
        app.run(train, "train")
        return
    # Without Hydra, which would compose another configuration and make another folder.
    with app.program("train"):
        if len(arguments) > 1:
            others = " ".join(argument for argument in arguments if argument != resumed)
            raise UserError(f"{resumed} must be the only argument: the run has its own config.yaml; leave out {others}")
        resume(Path(resumed.removeprefix("resume=")).expanduser())


if __name__ == "__main__":
    main()
