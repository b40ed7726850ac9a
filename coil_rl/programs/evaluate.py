"""`coil-evaluate`: drive a trained run beside its guide, or a guide alone, over the test tracks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from coil_rl.programs import app
from coil_rl.train.build import build_env
from coil_rl.train.evaluate_run import evaluate_run, outcome
from coil_rl.train.load import load_policy, read_config


def evaluate(config: DictConfig) -> float:
    """Judge what the configuration names; returns the mean reward of its deterministic policy."""
    torch.set_num_threads(config.threads)
    folder = Path(config.run_dir)
    folder.mkdir(parents=True, exist_ok=True)
    seed, agent = config.seed, None
    if config.run is not None:
        config, agent = restore(Path(config.run), config)
    evaluate_run(config, agent, folder, seed)
    return outcome(folder)


def restore(run: Path, asked: DictConfig) -> tuple[DictConfig, torch.nn.Module | None]:
    """The configuration of a run, with the tracks and the evaluation that were asked for, and its policy.

    Raises:
        UserError: if the folder holds no run, or one that does not fit together.
    """
    resolved: Any = OmegaConf.to_container(asked, resolve=True)
    # The run was trained with advice of its own; this is what else to show it.
    resolved["evaluation"]["advice"] |= resolved["degrade"]
    config = read_config(run, "run", {key: resolved[key] for key in ("track", "evaluation", "device")})
    if config.method.observes is None:
        return config, None
    return config, load_policy(run, config, build_env(config), config.evaluation.policy)


def main() -> None:
    """Entry point."""
    app.run(evaluate, "evaluate")


if __name__ == "__main__":
    main()
