"""`coil-train`: train a method, evaluate the policy beside its guides and draw the results."""

import sys
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from coil_rl.errors import UserError
from coil_rl.programs import app
from coil_rl.train.config import TrainConfig
from coil_rl.train.trust import trust_packages


def train(config: DictConfig) -> float:
    """Do one run and return the mean test reward of its deterministic policy."""
    from coil_rl.train.run import run

    if config.resume is not None:
        raise UserError(
            f"resume={config.resume} belongs on the command line, alone: coil-train resume=FOLDER"
        )
    return run(config)


def resume(folder: Path) -> float:
    """Finish a run that was stopped, and return the same as `train`.

    A folder without a run, or one that cannot be resumed or would write outside of its folder, is a
    `UserError`.
    """
    from coil_rl.train.check import check
    from coil_rl.train.run import resume_run
    from coil_rl.train.run_folder import is_evaluated, locked, read_config

    config = read_config(folder, "resume")
    folder = folder.absolute()
    if link := next((path for path in folder.rglob("*") if path.is_symlink()), None):
        problem = "is a link, so that the run could write outside of its folder"
        raise UserError(f"{link} {problem}; put the file in its place")
    config.run_dir = str(folder)
    if config.proxy:
        config.proxy["folder"] = str(folder / "distilled")  # not the folder that the file names
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
        trust = [argument for argument in arguments if argument.startswith("trust=")]
        if others := " ".join(
            argument for argument in arguments if argument not in (resumed, *trust)
        ):
            problem = (
                f"{resumed} takes no argument but trust=[PACKAGE]: the run has its own config.yaml"
            )
            raise UserError(f"{problem}; leave out {others}")
        trust_packages(
            OmegaConf.merge(OmegaConf.structured(TrainConfig), OmegaConf.from_dotlist(trust)).trust
        )
        resume(Path(resumed.removeprefix("resume=")).expanduser())


if __name__ == "__main__":
    main()
