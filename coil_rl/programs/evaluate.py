"""`coil-evaluate`: evaluate the policy of a run beside its guides, or guides alone."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from coil_rl.programs import app

# Keys that have an effect on the evaluation of a run, and on that of guides alone.
OF_A_RUN = ("run", "track", "degrade", "evaluation")
OF_GUIDES = ("preset", "env", "guide", *OF_A_RUN)
OWN = (
    "repeats",
    "policy",
    "gif",
    "advice",
    "fallback",
)  # keys of `evaluation` of the command, not of the run
OF_A_TRACK = ("cases", "env", "pictures", "sections")  # those that depend on `track`

if TYPE_CHECKING:
    from torch import nn


def evaluate(config: DictConfig) -> float:
    """Evaluate the configured run or guides, and return the mean reward of the deterministic policy."""
    import torch

    from coil_rl.train.evaluate_run import evaluate_run, report_outcome
    from coil_rl.train.fallback import build_fallback

    torch.set_num_threads(config.threads)
    folder, seed, agent, run = Path(config.run_dir), config.seed, None, config.run
    if run is not None:
        config, agent = restore(Path(run), config)
    evaluate_run(config, agent, folder, seed, build_fallback(config, Path(run or ""), agent))
    return report_outcome(folder)


def restore(run: Path, requested: DictConfig) -> tuple[DictConfig, nn.Module | None]:
    """Return the configuration of a run with the requested evaluation, and its policy.

    Everything is as in the run but for what the command line gives. A folder without a complete
    run, or one without tracks although tracks are given, is a `UserError`.
    """
    from coil_rl.errors import UserError
    from coil_rl.train.build import build_env
    from coil_rl.train.check import check_measures, check_values
    from coil_rl.train.load import load_policy
    from coil_rl.train.run_folder import read_config

    config = read_config(run, "run", {"device": requested.device})
    resolved: Any = OmegaConf.to_container(requested, resolve=True)
    own: Any = OmegaConf.to_container(config.evaluation.advice, resolve=True)
    # The advice of the training is evaluated too.
    resolved["evaluation"]["advice"] = own | resolved["evaluation"]["advice"] | resolved["degrade"]
    changed = list(OWN)
    for key, text in app.overrides() if HydraConfig.initialized() else ():
        if key == "track":
            if not config.track:
                raise UserError(f"{text} has no effect: run={run} has no tracks; leave it out")
            config.track = resolved["track"]
            changed += OF_A_TRACK
        elif key.startswith("evaluation."):
            changed.append(key.removeprefix("evaluation."))
    values = OmegaConf.create(resolved["evaluation"])
    for key in changed:
        OmegaConf.update(
            config.evaluation, key, OmegaConf.select(values, key), merge=False, force_add=True
        )
    if "cases" in config.evaluation.env:  # an env whose cases are numbered seeds
        config.evaluation.env["cases"] = config.evaluation.cases
    check_values(config)
    if config.method.observes is None:
        return config, None
    env = build_env(config)
    check_measures(config, env)
    return config, load_policy(run, config, env, config.evaluation.policy)


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration, and make the folder of the results."""
    given = config.run is not None
    reason = (
        f"run={config.run} has its own configuration"
        if given
        else "a guide is evaluated without an agent"
    )
    app.check_used(OF_A_RUN if given else OF_GUIDES, reason)
    app.check_run(config)


main = partial(app.run, evaluate, "evaluate", check)

if __name__ == "__main__":
    main()
