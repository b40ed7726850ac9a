"""How fast agents train: with and without the guide, PPO also beside the hand-written loop, and where its time goes."""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict

from coil_rl.benchmark.plain_ppo import PlainPPO
from coil_rl.benchmark.turns import Sections, Turns, median_ratio
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.train.build import build, build_bare_env, build_env, build_guides, build_learner
from coil_rl.train.experiment import Experiment, watched_keys
from coil_rl.train.rollout import Rollout
from coil_rl.transforms import GuideActions

METHODS = ("ppo", "coil")
SECTIONS = ("env", "guide", "policy", "update", "framework")
UPDATES = 2


class Training:
    """Our training as `coil-train` runs it, without the files; a call is one update and returns its frames.

    A learner with replay has then collected what it wants to begin with.

    Args:
        config: with `env`, `learner` and `methods`.
        method: one of `methods`.
        cars: B.
        steps: T.
    """

    def __init__(self, config: DictConfig, method: str, cars: int, steps: int) -> None:
        with open_dict(config):  # for the transforms of the method
            observed: Any = OmegaConf.merge(config, config.methods[method])
        env = build_env(observed, {"num_cars": cars})
        learner = build_learner(observed, env)
        rollout = Rollout(env, learner.policy, steps, [*learner.keys, *watched_keys(env, {})])
        # The experiment keeps its best policy in a file; that belongs to what it costs.
        self.folder = tempfile.TemporaryDirectory()
        self.experiment = Experiment(learner, rollout, 1, Path(self.folder.name))
        while isinstance(learner, OffPolicy) and len(learner.buffer) < learner.starts:
            self.experiment.update(0.0)

    def __call__(self) -> int:
        """Collect and learn once."""
        self.experiment.update(0.0)
        return self.experiment.rollout.frames

    def watch(self, sections: Sections) -> None:
        """Charge the parts of every later update to `SECTIONS`."""
        env = self.experiment.rollout.env
        for method in ("_step", "_reset"):
            sections.wrap(env.base_env, method, "env")
        for transform in env.transform:
            if isinstance(transform, GuideActions):
                for method in ("_call", "_reset"):
                    sections.wrap(transform, method, "guide")
        sections.wrap(self.experiment.learner.policy, "forward", "policy")
        sections.wrap(self.experiment.learner, "update", "update")


def has_yardstick(config: DictConfig) -> bool:
    """Whether it is PPO that steers by numbers, which is what was written by hand, here and by others."""
    by_numbers: bool = not config.action
    return by_numbers and config.learner["_target_"] == "coil_rl.learners.PPO"


def plain(config: DictConfig, method: str, cars: int, steps: int) -> Callable[[], int]:
    """The hand-written loop on the same env, with the same hyper-parameters."""
    env = build_bare_env(config, {"num_cars": cars})
    guide = next(iter(build_guides(config).values())) if method == "coil" else None
    learned: Any = OmegaConf.to_container(config.learner, resolve=True)
    node = {key: value for key, value in learned.items() if key not in ("compile", "action_gain")}
    node |= {"_target_": f"{PlainPPO.__module__}.{PlainPPO.__qualname__}"}
    learner: PlainPPO = build(node, "learner", env=env, guide=guide, steps=steps)

    def update() -> int:
        learner.update(learner.collect())
        return cars * steps

    return update


def measure_training(config: DictConfig, turns: Turns) -> list[dict[str, Any]]:
    """One row a batch: frames per second with and without the guide, of PPO also by hand, and what differences cost."""
    rows = []
    for batch in config.batches:
        cars, steps = batch.cars, batch.steps
        turns.tick(f"training {cars} x {steps}, beginning")
        ours = {method: Training(config, method, cars, steps) for method in METHODS}
        by_hand = METHODS if has_yardstick(config) else ()
        hands = {f"plain_{method}": plain(config, method, cars, steps) for method in by_hand}
        rates = turns.rates({**ours, **hands}, f"training {cars} x {steps}, ")
        rows.append(
            {
                "learner": type(ours["ppo"].experiment.learner).__name__,
                "cars": cars,
                "steps": steps,
                **{f"{name}_frames_per_s": statistics.median(rate) for name, rate in rates.items()},
                "coil_frame_cost_over_ppo": median_ratio(rates["ppo"], rates["coil"]),
                **{f"{method}_over_plain": median_ratio(rates[method], rates[f"plain_{method}"]) for method in by_hand},
                "rounds": rates,
            }
        )
    return rows


def measure_shares(config: DictConfig, turns: Turns) -> list[dict[str, Any]]:
    """One row a method and batch: the shares of `SECTIONS` in an update, collecting included."""
    rows = []
    for batch in config.batches:
        for method in METHODS:
            turns.tick(f"shares, {method} {batch.cars} x {batch.steps}")
            training = Training(config, method, batch.cars, batch.steps)
            training()
            sections = Sections(config.device)
            training.watch(sections)
            for _ in range(UPDATES):
                with sections.section("framework"):
                    training()
            total = sum(sections.seconds.values())
            shares = {name: sections.seconds.get(name, 0.0) / total for name in SECTIONS}
            rows.append({"method": method, "cars": batch.cars, "steps": batch.steps, **shares})
    return rows
