"""`coil-evaluate`: evaluate the policy of a run beside its guides, or guides alone, on the test tracks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from coil_rl.programs import app

# Keys that have an effect on the evaluation of a run, and on that of guides alone.
OF_A_RUN = ("run", "track", "degrade", "evaluation")
OF_GUIDES = ("preset", "env", "guide", *OF_A_RUN)

if TYPE_CHECKING:
    from torch import nn


def evaluate(config: DictConfig) -> float:
    """Evaluate the configured run or guides, and return the mean reward of the deterministic policy."""
    import torch

    from coil_rl.train.evaluate_run import evaluate_run, report_outcome

    torch.set_num_threads(config.threads)
    folder = Path(config.run_dir)
    folder.mkdir(parents=True, exist_ok=True)
    seed, agent = config.seed, None
    if config.run is not None:
        config, agent = restore(Path(config.run), config)
    evaluate_run(config, agent, folder, seed)
    return report_outcome(folder)


def restore(run: Path, requested: DictConfig) -> tuple[DictConfig, nn.Module | None]:
    """Return the configuration of a run with the requested evaluation, and its policy.

    The tracks are those of the run unless the command line gives others.

    Raises:
        UserError: if the folder holds no complete run.
    """
    from coil_rl.train.build import build_env
    from coil_rl.train.check import check_values
    from coil_rl.train.load import load_policy
    from coil_rl.train.run_folder import read_config

    if HydraConfig.initialized() and "track" not in dict(app.overrides()):
        requested.track = read_config(run, "run").track
    resolved: Any = OmegaConf.to_container(requested, resolve=True)
    # The advice of the training is evaluated too.
    resolved["evaluation"]["advice"] |= resolved["degrade"]
    config = read_config(run, "run", {key: resolved[key] for key in ("track", "evaluation", "device")})
    check_values(config)
    if config.method.observes is None:
        return config, None
    return config, load_policy(run, config, build_env(config), config.evaluation.policy)


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration, and make the folder of the results."""
    given = config.run is not None
    reason = f"run={config.run} has its own configuration" if given else "a guide is evaluated without an agent"
    app.check_used(OF_A_RUN if given else OF_GUIDES, reason)
    app.check_run(config)


def main() -> None:
    """Entry point."""
    app.run(evaluate, "evaluate", check)


if __name__ == "__main__":
    main()
