"""`coil-evaluate`: drive a trained run beside its guide, or a guide alone, over the test tracks."""

from __future__ import annotations

from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from coil_rl import checkpoint
from coil_rl.build import build, build_env
from coil_rl.errors import UserError
from coil_rl.programs import app
from coil_rl.programs.judge import judge


def evaluate(config: DictConfig) -> float:
    """Judge what the configuration names; returns the mean reward of its deterministic policy."""
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    folder = Path(config.run_dir)
    folder.mkdir(parents=True, exist_ok=True)
    agent = None
    if config.run is not None:
        config, agent = restore(Path(config.run), config)
    table = judge(config, agent, folder)
    mean = next(row for row in reversed(table) if row["track"] == "mean" and row["actions"] == "deterministic")
    print(f"{mean['driver']}: mean reward {mean['reward']:.1f}, {mean['completed']:.0%} completed; see {folder}")
    return float(mean["reward"])


def restore(run: Path, asked: DictConfig) -> tuple[DictConfig, torch.nn.Module | None]:
    """The configuration of a run, with the tracks and the evaluation that were asked for, and its policy.

    Raises:
        UserError: if the folder holds no run.
    """
    if not (run / "config.yaml").is_file():
        raise UserError(f"run={run} is not the folder of a run: it has no config.yaml")
    config = OmegaConf.load(run / "config.yaml")
    if not isinstance(config, DictConfig):
        raise UserError(f"{run / 'config.yaml'} is not the configuration of a run")
    for key in ("track", "evaluation", "device"):
        config[key] = OmegaConf.to_container(asked[key], resolve=True) if key != "device" else asked[key]
    if config.method.observes is None:
        return config, None
    env = build_env(config)
    learner = build(config.learner, "learner", env=env, in_keys=list(config.method.observes))
    learner.policy.load_state_dict(checkpoint.load(run / f"policy_{config.evaluation.policy}.pt", config.device))
    return config, learner.policy


def main() -> None:
    """Entry point."""
    app.run(evaluate, "evaluate")


if __name__ == "__main__":
    main()
