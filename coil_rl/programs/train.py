"""`coil-train`: train a method, evaluate it beside its guide, and draw what happened."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch
from omegaconf import DictConfig
from tqdm import tqdm

from coil_rl import checkpoint
from coil_rl.build import build, build_env, build_learner
from coil_rl.errors import UserError
from coil_rl.experiment import Experiment, watched_keys
from coil_rl.files import whole_file
from coil_rl.programs import app, run_folder
from coil_rl.programs.judge import drive_guides, is_judged, judge, outcome
from coil_rl.report import draw_learning_curves
from coil_rl.rollout import Rollout
from coil_rl.trained import configuration


def train(config: DictConfig) -> float:
    """Run one configuration; returns the mean test reward of its deterministic policy."""
    if config.resume is not None:
        raise UserError(f"resume={config.resume} belongs on the command line, alone: coil-train resume=FOLDER")
    folder = Path(config.run_dir)
    with run_folder.claimed(folder):
        if config.existing == "resume" and run_folder.holds(folder, config):
            return outcome(folder) if is_judged(folder) else finish(config, folder, resumed=True)
        run_folder.begin(config, folder)
        return finish(config, folder)


def resume(folder: Path) -> float:
    """Go on with a run that was stopped; returns what `train` would have, after the same numbers.

    Raises:
        UserError: if the folder holds no run, or one that cannot go on.
    """
    config = configuration(folder, "resume")
    folder = folder.absolute()
    config.run_dir = str(folder)
    with run_folder.claimed(folder):
        return outcome(folder) if is_judged(folder) else finish(config, folder, resumed=True)


def finish(config: DictConfig, folder: Path, *, resumed: bool = False) -> float:
    """Do what is left of a run."""
    torch.set_num_threads(config.threads)
    try:
        agent = None if config.method.observes is None else learn(config, folder, resumed)
        torch.manual_seed(config.seed)
        judge(config, agent, folder)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"go on with: coil-train resume={folder}") from None
    return outcome(folder)


def learn(config: DictConfig, folder: Path, resumed: bool) -> torch.nn.Module:
    """Train, draw the learning curve and return the policy to judge."""
    guides = guides_on_training_tracks(config, folder / "guide_return.json")
    # After the guides, which another process may have driven already.
    torch.manual_seed(config.seed)
    env = build_env(config)
    learner = build_learner(config, env)
    keys = [*learner.keys, *watched_keys(env, config.watch)]
    experiment = Experiment(
        learner,
        Rollout(env, learner.policy, config.budget.steps, keys),
        config.budget.frames,
        folder,
        logger=build(config.logger, "logger") if config.logger else None,
        watch=config.watch,
        checkpoint_every=config.checkpoint_every,
    )
    if resumed:
        experiment.resume()
    rows = experiment.run(max(guides.values()))
    draw_learning_curves({config.label: [rows]}, folder / "learning_curve.png", guides=guides)
    if hasattr(learner, "export"):  # not every learner has something to leave besides its policy
        learner.export(folder)
    learner.policy.load_state_dict(checkpoint.load(folder / f"policy_{config.evaluation.policy}.pt", config.device))
    return learner.policy


def guides_on_training_tracks(config: DictConfig, file: Path) -> dict[str, float]:
    """Each guide's own mean return where the agent trains: the lines to beat. A file remembers them."""
    if file.exists():
        return {name: float(value) for name, value in json.loads(file.read_text()).items()}
    names = [track.name for track in build(config.track.train, "track.train")]
    with tqdm(unit="step", desc="guide on the training tracks", leave=False, mininterval=0.5) as bar:
        drives = drive_guides(config, {"assignment": "cyclic"}, names, bar.update)
    means = {driver: drive.mean_reward for driver, drive in drives.items()}
    with whole_file(file) as unfinished:
        unfinished.write_text(json.dumps(means, indent=2) + "\n")
    return means


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
