"""`coil-train`: train a method, evaluate the policy beside its guides and draw the results."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from coil_rl.config.compose import default_learner
from coil_rl.config.folder import PREFIX
from coil_rl.config.schema import TrainConfig
from coil_rl.config.trust import trust_packages
from coil_rl.errors import UserError
from coil_rl.output import quietly, say
from coil_rl.programs import app, folders, sweeps

# What may be given beside resume=FOLDER.
BESIDE_RESUME = ("trust=", "budget.frames=", "env.workers=", "changed=")


def train(config: DictConfig) -> float:
    """Do one run and return the mean test reward of its deterministic policy."""
    from coil_rl.config.assemble import run_configured
    from coil_rl.report.table import return_format

    if config.resume is not None:
        raise UserError(
            f"resume={config.resume} belongs on the command line, alone: coil-train resume=FOLDER"
        )
    if not sweeps.is_sweep():
        return run_configured(config, command=app.command_line())
    with quietly(bars=True):  # the whole text is in the folder of each run
        reward = run_configured(config, command=app.command_line())
    shown = format(reward, return_format([reward]))
    say(f"{config.label}, seed {config.seed}: mean test reward {shown}; see {config.run_dir}")
    return reward


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration, or for what nothing reads.

    In a sweep a word may be meant for other runs, so each run says what it ignores.
    """
    from coil_rl.config import check as checks
    from coil_rl.config.folder import holds
    from coil_rl.run.folder import is_evaluated

    folder = Path(config.run_dir)
    if not (config.existing == "resume" and is_evaluated(folder) and holds(folder, config)):
        checks.check(config)
    words = [text for _, text in app.overrides()]
    if not sweeps.is_sweep():
        checks.check_read(config, words)
        return
    for sentence in checks.unread(config, words):
        say(f"{sentence}, if no other run of this sweep reads it", error=True)


def resume(folder: Path, frames: int | None = None, workers: Any = None, changed: str = "") -> None:
    """Finish a run that was stopped, or train it for longer.

    Args:
        frames: new length.
        workers: number of processes of the env; its numbers do not depend on it.
        changed: as of `Run.train`.

    Raises:
        UserError: for a folder without a run, or one that cannot be resumed or would write outside
            of its folder.
    """
    from coil_rl.config.assemble import assemble
    from coil_rl.config.check import check
    from coil_rl.config.folder import read_config
    from coil_rl.run.folder import is_evaluated

    config = read_config(folder, "resume", goes_on=True)
    folder = folder.absolute()
    if workers is not None:
        if "workers" not in config.env:
            raise UserError(f"env.workers={workers} has no effect on the env of {folder}")
        config.env.workers = workers
    run = assemble(config)
    try:
        if frames is not None or not is_evaluated(folder):
            check(config)
    except UserError as error:
        raise UserError(f"{folder / 'config.yaml'}: {error}") from error
    run.train(frames, changed=changed)


def resume_from_command_line(resumed: str, others: Sequence[str]) -> None:
    """Resume a run as the arguments of the program say, without Hydra.

    Hydra would compose another configuration and make another folder.

    Args:
        resumed: the argument `resume=FOLDER`.
        others: the other arguments.
    """
    unknown = [argument for argument in others if not argument.startswith(BESIDE_RESUME)]
    if unknown:
        raise UserError(
            f"{resumed} takes no argument but trust=[PACKAGE], budget.frames=NUMBER, "
            "env.workers=NUMBER and changed=accept: the run has its own config.yaml; leave out "
            f"{' '.join(unknown)}"
        )
    words = OmegaConf.from_dotlist(list(others))
    changed = str(words.pop("changed", ""))
    given = OmegaConf.merge(OmegaConf.structured(TrainConfig), words)
    trust_packages(given.trust)
    lengthens = any(argument.startswith("budget.frames=") for argument in others)
    name = resumed.removeprefix("resume=")
    if name.startswith(PREFIX):
        raise UserError(
            f"{resumed}: a shipped policy has no training that could go on; begin a run with it by "
            f"init={name}"
        )
    folder = folders.folder(name)
    frames = given.budget.frames if lengthens else None
    resume(folder, frames, OmegaConf.select(words, "env.workers"), changed)


def main() -> None:
    """Entry point."""
    arguments = sys.argv[1:]
    resumed = next((argument for argument in arguments if argument.startswith("resume=")), None)
    if resumed is None:
        app.run_program(train, "train", check, further=default_learner)
        return
    with app.program("train"):
        resume_from_command_line(resumed, [each for each in arguments if each != resumed])


if __name__ == "__main__":
    main()
