"""`coil-evaluate`: drive a trained run beside its guide, or a guide alone, over the test tracks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from coil_rl import checkpoint
from coil_rl.build import build, build_env
from coil_rl.config import Train
from coil_rl.errors import UserError
from coil_rl.programs import app
from coil_rl.programs.judge import judge
from coil_rl.programs.sentence import sentence


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
        UserError: if the folder holds no run, or one that does not fit together.
    """
    path = run / "config.yaml"
    if not path.is_file():
        raise UserError(f"run={run} is not the folder of a run: it has no config.yaml")
    try:
        kept = OmegaConf.load(path)
        if not isinstance(kept, DictConfig):
            raise UserError(f"{path} is not the configuration of a run, but a list")
        for key in ("track", "evaluation", "device"):
            kept[key] = OmegaConf.to_container(asked[key], resolve=True) if key != "device" else asked[key]
        config: Any = OmegaConf.merge(OmegaConf.structured(Train), kept)
        OmegaConf.to_container(config, throw_on_missing=True)
    except (OmegaConfBaseException, yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        raise UserError(f"{path} is not the configuration of a run ({sentence(error)})") from error
    if config.method.observes is None:
        return config, None
    env = build_env(config)
    learner = build(config.learner, "learner", env=env, in_keys=list(config.method.observes))
    weights = run / f"policy_{config.evaluation.policy}.pt"
    try:
        learner.policy.load_state_dict(checkpoint.load(weights, config.device))
    except (RuntimeError, TypeError, AttributeError) as error:
        raise UserError(
            f"{weights} does not fit the networks that {path} describes; give the folder as it was"
        ) from error
    return config, learner.policy


def main() -> None:
    """Entry point."""
    app.run(evaluate, "evaluate")


if __name__ == "__main__":
    main()
