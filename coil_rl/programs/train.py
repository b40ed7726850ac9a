"""`coil-train`: train a method, evaluate it beside its guide, and draw what happened."""

from __future__ import annotations

import sys
from pathlib import Path

from omegaconf import DictConfig

from coil_rl.errors import UserError
from coil_rl.programs import app
from coil_rl.train import run, run_folder
from coil_rl.train.load import read_config


def train(config: DictConfig) -> float:
    """Run one configuration; returns the mean test reward of its deterministic policy."""
    if config.resume is not None:
        raise UserError(f"resume={config.resume} belongs on the command line, alone: coil-train resume=FOLDER")
    return run.run(config)


def resume(folder: Path) -> float:
    """Go on with a run that was stopped; returns what `train` would have, after the same numbers.

    Raises:
        UserError: if the folder holds no run, or one that cannot go on.
    """
    config = read_config(folder, "resume")
    folder = folder.absolute()
    config.run_dir = str(folder)
    with run_folder.locked(folder):
        return run.go_on(config, folder)


def main() -> None:
    """Entry point."""
    words = sys.argv[1:]
    run = next((word for word in words if word.startswith("resume=")), None)
    if run is None:
        app.run(train, "train")
    else:
        # Without Hydra, which would compose another configuration and make another folder.
        with app.program("train"):
            if len(words) > 1:
                others = " ".join(word for word in words if word != run)
                raise UserError(f"{run} goes alone: that run's own config.yaml says the rest; leave out {others}")
            resume(Path(run.removeprefix("resume=")).expanduser())


if __name__ == "__main__":
    main()
