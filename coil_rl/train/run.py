"""A training run from its configuration to its tables: train, draw, evaluate, resume."""

import json
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.errors import NO_SPACE, UserError, file_of_a_run
from coil_rl.files import write_text
from coil_rl.learners.learner import Callback, Learner
from coil_rl.report import draw_learning_curves, draw_phases
from coil_rl.report.runs import EVALUATION, SELECTION
from coil_rl.train import build, checkpoint, distillation
from coil_rl.train.brake import SelectionCases
from coil_rl.train.curve import EvaluationCurve, measures
from coil_rl.train.evaluate_run import driver_names, evaluate_run, report_outcome
from coil_rl.train.experiment import Experiment, watched_keys
from coil_rl.train.fallback import build_fallback
from coil_rl.train.load import PROXIES, load_guides, weights_file
from coil_rl.train.measures import measures_of
from coil_rl.train.rollout import Rollout
from coil_rl.train.run_folder import (
    begin,
    flat,
    holds,
    is_evaluated,
    locked,
    report_changed_versions,
)


def run(config: DictConfig, *, wait: bool = False) -> float:
    """Do a run, or resume it if `existing=resume`, and return the mean test reward of the deterministic agent.

    A folder that holds another run, or that another process uses if `wait` is not set, is a
    `UserError`.
    """
    folder = Path(config.run_dir)
    with locked(folder, wait=wait):
        if config.existing == "resume" and holds(folder, config):
            return resume_run(config, folder)
        begin(config, folder)
        return _finish(config, folder)


def resume_run(config: DictConfig, folder: Path) -> float:
    """Finish the run in a folder, and return the same as `run`."""
    return report_outcome(folder) if is_evaluated(folder) else _finish(config, folder, resumed=True)


def _finish(config: DictConfig, folder: Path, *, resumed: bool = False) -> float:
    torch.set_num_threads(config.threads)
    try:
        if resumed:
            report_changed_versions(folder)
        agent = None if config.method.observes is None else _train(config, folder, resumed)
        evaluate_run(config, agent, folder, config.seed, build_fallback(config, folder, agent))
        return report_outcome(folder)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"continue with: coil-train resume={folder}") from None
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        problem = f"{error.filename or folder} cannot be written ({error.strerror})"
        raise UserError(
            f"{problem}; make room, and continue with coil-train resume={folder}"
        ) from error


def _train(config: DictConfig, folder: Path, resumed: bool) -> torch.nn.Module:
    """Train, draw the learning curve and return the policy to evaluate."""
    improves_guides = build.trains_guides(config)
    if improves_guides:
        _distil(config, folder)
    guide_returns = _saved_guide_returns(config, folder / "guide_return.json")
    # After the guides, which a resumed run does not drive again.
    torch.manual_seed(config.seed)
    env = build.compile_steps(config, build.build_env(config, config.training.env))
    learner = build.build_learner(
        config, env, load_guides(folder, config) if improves_guides else None
    )
    keys = [*learner.keys, *watched_keys(env, config.watch)]
    experiment = Experiment(
        learner,
        Rollout(env, learner.policy, config.budget.steps, keys, config.training.noise_correlation),
        config.budget.frames,
        folder,
        logger=build.build(config.logger, "logger") if config.logger else None,
        watch=config.watch,
        checkpoint_every=config.checkpoint_every,
        callbacks=_callbacks(config, learner),
        curve=_curve(config, folder, learner.policy),
        identity=flat(config),
    )
    if resumed:
        experiment.resume()
    start = time.monotonic()
    rows = experiment.run(max(guide_returns.values(), default=None))
    if not resumed:  # the time before the interruption is unknown
        write_text(
            folder / "training_time.json",
            json.dumps({"seconds": time.monotonic() - start}, indent=2),
        )
    if improves_guides:
        draw_phases(rows, list(learner.guides), folder / "learning_curve.png", title=config.label)
    else:
        draw_learning_curves(
            {config.label: [rows]}, folder / "learning_curve.png", guides=guide_returns
        )
    learner.export(folder)
    learner.policy.load_state_dict(
        checkpoint.load(weights_file(folder, config.evaluation.policy), config.device)
    )
    return learner.policy


def _distil(config: DictConfig, folder: Path) -> None:
    """Put a proxy of each guide without parameters into the folder of a run."""
    if (folder / PROXIES).is_dir():
        return
    proxies = {}
    for name in distillation.guides_without_parameters(build.build_guides(config)):
        proxy_config = distillation.proxy_config(config, name)
        run(proxy_config, wait=True)
        proxies[name] = Path(proxy_config.run_dir)
    torch.set_num_threads(config.threads)
    distillation.copy_proxies(proxies, folder)


class GuideReturns:
    """Mean return of each guide of a learner in the cases of the evaluation; a `Callback`."""

    def __init__(self, config: DictConfig, guides: Mapping[str, TensorDictModuleBase]) -> None:
        self.config, self.guides = config, guides
        self.each_phase = config.evaluation.guides == "phases"
        self.names: Sequence[str] = [f"guide/{name}" for name in guides]

    def due(self, update: int, updates: int, row: Mapping[str, float]) -> bool:
        """Return whether the guides have changed, or the training begins or ends."""
        return update in (0, updates) or bool(self.each_phase and row["learner/guides_changed"])

    def after_update(self, update: int) -> dict[str, float]:
        """Return the means with the present parameters, by their names in the log."""
        return dict(zip(self.names, _guide_returns(self.config, self.guides).values(), strict=True))


def _saved_guide_returns(config: DictConfig, file: Path) -> dict[str, float]:
    if file.exists():
        with file_of_a_run(file, "remove it, and the run measures it again"):
            numbers = json.loads(file.read_text())
            return {name: float(numbers[name]) for name in driver_names(config.guide)}
    returns = _guide_returns(config)
    write_text(file, json.dumps(returns, indent=2))
    return returns


def _guide_returns(
    config: DictConfig, guides: Mapping[str, TensorDictModuleBase] | None = None
) -> dict[str, float]:
    """Return the mean return of each guide in the cases of the evaluation."""
    if EVALUATION not in config.evaluation.curve.cases or not (guides or config.guide):
        return {}
    guides = guides or build.build_guides(config)
    env, policy = build.build_guided_env(config, build.cases_node(config, EVALUATION), guides)
    with torch.random.fork_rng():
        returns = measures(env, policy)["return"].view(len(guides), -1).mean(1)
    return dict(zip(driver_names(guides), returns.tolist(), strict=True))


def _callbacks(config: DictConfig, learner: Learner) -> list[Callback]:
    """Return what a run calls between updates: the callbacks of its learner, and a measurement of trained guides."""
    callbacks = [*learner.callbacks(_selection_cases(config, learner))]
    if build.trains_guides(config):
        callbacks.append(GuideReturns(config, learner.guides))
    return callbacks


def _selection_cases(config: DictConfig, learner: Learner) -> SelectionCases:
    failure = measures_of(config.evaluation.measures).get("crashed")

    def make(policies: int, count: int) -> EnvBase:
        if SELECTION not in config.evaluation.curve.cases:
            raise UserError(
                f"learner.anchor needs evaluation.curve.cases.{SELECTION}, cases for its drives; "
                "give it"
            )
        return _build_cases(config, SELECTION, policies, count)

    return SelectionCases(learner.policy, make, 24 if failure is None else 96, failure)


def _build_cases(config: DictConfig, cases: str, drivers: int, count: int | None = None) -> EnvBase:
    return build.build_env(config, build.cases_node(config, cases, drivers, count))


def _curve(
    config: DictConfig, folder: Path, policy: TensorDictModuleBase
) -> EvaluationCurve | None:
    """Return the evaluation curve of a run; None without cases."""
    curve = config.evaluation.curve
    envs = {cases: partial(_build_cases, config, cases) for cases in curve.cases}
    options = {"watch": config.watch, "points": curve.points, "batches": curve.batches}
    return EvaluationCurve(folder, policy, envs, **options) if envs else None
