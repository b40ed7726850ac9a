"""What a training run does from its configuration to its tables: train, draw, judge, and go on where it was stopped."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from pathlib import Path

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase

from coil_rl.files import write_text
from coil_rl.report import draw_learning_curves, draw_phases
from coil_rl.train import checkpoint, distillation, load, run_folder
from coil_rl.train.build import build, build_env, build_guides, build_learner, trains_guides
from coil_rl.train.evaluate_run import evaluate_run, is_evaluated, outcome
from coil_rl.train.experiment import Experiment, watched_keys
from coil_rl.train.guide_drives import drive_guides
from coil_rl.train.rollout import Rollout


def run(config: DictConfig, *, wait: bool = False) -> float:
    """Do a run, or what is left of one where the folder may hold it; returns the deterministic agent's mean reward.

    Args:
        config: of the run.
        wait: while another process is in the folder.

    Raises:
        UserError: if the folder cannot be used.
    """
    folder = Path(config.run_dir)
    with run_folder.locked(folder, wait=wait):
        if config.existing == "resume" and run_folder.holds(folder, config):
            return go_on(config, folder)
        run_folder.begin(config, folder)
        return finish(config, folder)


def go_on(config: DictConfig, folder: Path) -> float:
    """Do what is left of a run that the folder holds, if anything is."""
    return outcome(folder) if is_evaluated(folder) else finish(config, folder, resumed=True)


def finish(config: DictConfig, folder: Path, *, resumed: bool = False) -> float:
    """Train and judge, from the beginning or from the last checkpoint."""
    torch.set_num_threads(config.threads)
    try:
        agent = None if config.method.observes is None else learn(config, folder, resumed)
        evaluate_run(config, agent, folder, config.seed)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"go on with: coil-train resume={folder}") from None
    return outcome(folder)


def learn(config: DictConfig, folder: Path, resumed: bool) -> torch.nn.Module:
    """Train, draw the learning curve and return the policy to judge."""
    improved = trains_guides(config)
    if improved:
        distil(config, folder)
    guides = guides_on_training_tracks(config, folder / "guide_return.json")
    # After the guides, which another process may have driven already.
    torch.manual_seed(config.seed)
    env = build_env(config)
    learner = build_learner(config, env, load.load_guides(folder, config) if improved else None)
    keys = [*learner.keys, *watched_keys(env, config.watch)]
    experiment = Experiment(
        learner,
        Rollout(env, learner.policy, config.budget.steps, keys),
        config.budget.frames,
        folder,
        logger=build(config.logger, "logger") if config.logger else None,
        watch=config.watch,
        checkpoint_every=config.checkpoint_every,
        probe=GuideReturns(config, learner.guides) if improved else None,
    )
    if resumed:
        experiment.resume()
    began = time.monotonic()
    rows = experiment.run(max(guides.values()))
    if not resumed:  # else nobody knows how long the part before took
        _write_json({"seconds": time.monotonic() - began}, folder / "training_time.json")
    if improved:
        draw_phases(rows, list(learner.guides), folder / "learning_curve.png", title=config.label)
    else:
        draw_learning_curves({config.label: [rows]}, folder / "learning_curve.png", guides=guides)
    if hasattr(learner, "export"):  # not every learner has something to leave besides its policy
        learner.export(folder)
    learner.policy.load_state_dict(checkpoint.load(folder / f"policy_{config.evaluation.policy}.pt", config.device))
    return learner.policy


def guides_on_training_tracks(config: DictConfig, file: Path) -> dict[str, float]:
    """Each guide's own mean return where the agent trains: the lines to beat. A file remembers them."""
    if file.exists():
        return {name: float(value) for name, value in json.loads(file.read_text()).items()}
    means = _on_training_tracks(config)
    _write_json(means, file)
    return means


def _write_json(numbers: Mapping[str, float], file: Path) -> None:
    write_text(file, json.dumps(numbers, indent=2))


def distil(config: DictConfig, folder: Path) -> None:
    """See that the folder of a run has a proxy of each of its guides that has no parameters."""
    if (folder / load.PROXIES).is_dir():
        return
    made = {}
    for name in distillation.guides_without_parameters(build_guides(config)):
        wanted = distillation.proxy_config(config, name)
        run(wanted, wait=True)
        made[name] = Path(wanted.run_dir)
    torch.set_num_threads(config.threads)
    distillation.copy_proxies(made, folder)


class GuideReturns:
    """Drives each guide of a learner alone over the training tracks: is a guide that learns to be heard still good?

    Args:
        config: of the run.
        guides: as they are now, by name.
    """

    def __init__(self, config: DictConfig, guides: Mapping[str, TensorDictModuleBase]) -> None:
        self.config, self.guides = config, guides
        self.each_phase = config.evaluation.guides == "phases"

    @property
    def unknown(self) -> dict[str, float]:
        """What stands in the log where nobody looked."""
        return {f"guide/{name}": math.nan for name in self.guides}

    def __call__(self) -> dict[str, float]:
        """The mean return of each guide."""
        return dict(zip(self.unknown, _on_training_tracks(self.config, self.guides).values(), strict=True))


def _on_training_tracks(
    config: DictConfig, guides: Mapping[str, TensorDictModuleBase] | None = None
) -> dict[str, float]:
    names = [track.name for track in build(config.track.train, "track.train")]
    drives = drive_guides(config, {"assignment": "cyclic"}, names, guides)
    return {driver: drive.mean_reward for driver, drive in drives.items()}
