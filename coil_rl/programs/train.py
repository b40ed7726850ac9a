"""`coil-train`: train a method, evaluate it beside its guide, and draw what happened."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from coil_rl import checkpoint
from coil_rl.build import build, build_env, build_guide
from coil_rl.errors import UserError
from coil_rl.evaluation import drive
from coil_rl.experiment import Experiment, watched_keys
from coil_rl.programs import app
from coil_rl.programs.judge import judge
from coil_rl.programs.versions import versions
from coil_rl.report import draw_learning_curves
from coil_rl.rollout import Rollout


def train(config: DictConfig) -> float:
    """Run one configuration; returns the mean test reward of its deterministic policy."""
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    folder = Path(config.run_dir)
    if (folder / "config.yaml").exists():
        raise UserError(f"{folder} already holds a run; choose another folder with hydra.run.dir=FOLDER")
    folder.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(OmegaConf.create(OmegaConf.to_container(config, resolve=True)), folder / "config.yaml")
    (folder / "versions.json").write_text(json.dumps(versions(), indent=2) + "\n")

    agent = None
    if config.method.observes is not None:
        agent = learn(config, folder)
    table = judge(config, agent, folder)
    mean = next(row for row in reversed(table) if row["track"] == "mean" and row["actions"] == "deterministic")
    print(f"{mean['driver']}: mean test reward {mean['reward']:.1f}, {mean['completed']:.0%} completed; see {folder}")
    return float(mean["reward"])


def learn(config: DictConfig, folder: Path) -> torch.nn.Module:
    """Train, draw the learning curve and return the policy to judge."""
    env = build_env(config)
    learner = build(config.learner, "learner", env=env, in_keys=list(config.method.observes))
    keys = [*learner.keys, "episode_reward", *watched_keys(config.watch)]
    experiment = Experiment(
        learner,
        Rollout(env, learner.policy, config.budget.steps, keys),
        config.budget.frames,
        folder,
        logger=build(config.logger, "logger") if config.logger else None,
        watch=config.watch,
        checkpoint_every=config.checkpoint_every,
    )
    guide_return = guide_on_training_tracks(config)
    rows = experiment.run(guide_return)
    draw_learning_curves({config.method.name: [rows]}, folder / "learning_curve.png", guide=guide_return)
    learner.policy.load_state_dict(checkpoint.load(folder / f"policy_{config.evaluation.policy}.pt", config.device))
    return learner.policy


def guide_on_training_tracks(config: DictConfig) -> float:
    """The guide's own mean return where the agent trains: the line to beat."""
    tracks = build(config.track.train, "track.train")
    env = build_env(config, {"assignment": "cyclic", "num_cars": len(tracks)}, observed=False)
    with tqdm(unit="step", desc="guide on the training tracks", leave=False, mininterval=0.5) as bar:
        episodes = drive(env, build_guide(config), tick=bar.update).episodes
    return sum(episode["reward"] for episode in episodes) / len(episodes)


def main() -> None:
    """Entry point."""
    app.run(train, "train")


if __name__ == "__main__":
    main()
