"""The root of every program's configuration, typed, so that a misspelt top-level key fails at once."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf

from coil_rl.train.fingerprint import fingerprint

# Two runs started within a microsecond of each other still get folders of their own.
OmegaConf.register_new_resolver("pid", os.getpid, replace=True)
# What a table has entries for, as part of a label: ${names:${degrade},intact}
OmegaConf.register_new_resolver("names", lambda table, none: "_".join(map(str, table)) or none, replace=True)
# What a run is, as part of the name of its folder: ${label}_seed${seed}_${fingerprint:}
OmegaConf.register_new_resolver("fingerprint", lambda *, _root_: fingerprint(_root_), replace=True)


def agent_label(*, _root_: Any) -> str:
    """What an agent is called: by its method, and by its learner where that is neither PPO nor the method's own."""
    name = str(_root_.method.name)
    if OmegaConf.is_missing(_root_, "learner") or _root_.method.learner != "agent":
        return name
    kind = str(_root_.learner.get("_target_", "")).rpartition(".")[2].lower()
    if kind in ("", "ppo"):
        return name
    return kind if name == "ppo" else f"{name}_{kind}"


OmegaConf.register_new_resolver("agent_label", agent_label, replace=True)


@dataclass
class Budget:
    """How much experience a run collects, and how much of it between two updates."""

    frames: int = 1
    cars: int = MISSING
    steps: int = 1


@dataclass
class Evaluation:
    """How a policy is judged."""

    env: dict[str, Any] = field(default_factory=dict)
    advice: dict[str, Any] = field(default_factory=dict)
    repeats: int = 5
    policy: str = "last"
    guides: str = "phases"
    gif: bool = True


@dataclass
class Method:
    """What the agent learns from, if there is an agent, and by what kind of learner."""

    name: str = MISSING
    observes: list[str] | None = MISSING
    transforms: dict[str, Any] = field(default_factory=dict)
    needs_guide: bool = MISSING
    learner: str = "agent"


@dataclass
class Common:
    """What every program that drives has."""

    defaults: list[Any] = field(default_factory=lambda: [{"override /hydra/callbacks": "refusal"}, "_self_"])
    preset: dict[str, Any] = MISSING
    track: dict[str, Any] = MISSING
    env: dict[str, Any] = MISSING
    guide: dict[str, Any] = MISSING
    degrade: dict[str, Any] = field(default_factory=dict)
    method: Method = field(default_factory=Method)
    also_observes: list[str] = field(default_factory=list)
    action: dict[str, Any] = field(default_factory=dict)
    budget: Budget = field(default_factory=Budget)
    evaluation: Evaluation = field(default_factory=Evaluation)
    seed: int = 0
    device: str = "cpu"
    threads: int = 2
    run_dir: str = MISSING


@dataclass
class Train(Common):
    """Configuration of `coil-train`."""

    label: str = MISSING
    learner: dict[str, Any] = MISSING
    logger: dict[str, Any] | None = None
    proxy: dict[str, Any] = field(default_factory=dict)
    watch: dict[str, dict[str, list[str]]] = field(default_factory=dict)
    checkpoint_every: int = 10
    existing: str = "refuse"
    resume: str | None = None


@dataclass
class Evaluate(Common):
    """Configuration of `coil-evaluate`."""

    run: str | None = None


@dataclass
class Report:
    """Configuration of `coil-report`."""

    defaults: list[Any] = field(default_factory=lambda: [{"override /hydra/callbacks": "refusal"}, "_self_"])
    folder: Any = MISSING
    actions: str = "deterministic"
    against: str | None = None
    resamples: int = 2000
    seed: int = 0


@dataclass
class Listen(Common):
    """Configuration of `coil-listen`."""

    run: str = MISSING
    donors: int = 16
    turn_radius: float = 10.0
    approach: float = 4.0
    bin: float = 1.0


@dataclass
class Replay:
    """Configuration of `coil-replay`."""

    defaults: list[Any] = field(default_factory=lambda: [{"override /hydra/callbacks": "refusal"}, "_self_"])
    recording: Any = MISSING
    runs: list[str] = field(default_factory=list)
    policy: str = "last"
    strict: bool = False
    preset: dict[str, Any] = MISSING
    env: dict[str, Any] = MISSING
    guide: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    device: str = "cpu"
    threads: int = 1
    run_dir: str = MISSING


@dataclass
class RunsBudget:
    """How many runs results are made from, and what they are given."""

    seeds: int = MISSING
    note: str | None = None
    every: list[str] = field(default_factory=list)
    only: dict[str, list[str]] = field(default_factory=dict)


@dataclass
class Robot(Common):
    """Configuration of `coil-robot`."""

    steps: list[str] = MISSING
    runs: list[str] = field(default_factory=list)
    recordings: Any = field(default_factory=list)
    figure_25: dict[str, Any] = MISSING
    table_6: dict[str, Any] = MISSING


@dataclass
class Reproduce:
    """Configuration of `coil-reproduce`."""

    defaults: list[Any] = field(default_factory=lambda: [{"override /hydra/callbacks": "refusal"}, "_self_"])
    table: Any = None
    figure: Any = None
    claim: Any = None
    all: bool = False
    budget: str = MISSING
    budgets: dict[str, RunsBudget] = MISSING
    aliases: dict[str, str] = field(default_factory=dict)
    threads: int = 1
    train: list[str] = field(default_factory=list)
    known_problems: list[str] = field(default_factory=list)
    not_reproduced: list[str] = field(default_factory=list)
    results: dict[str, Any] = MISSING
    run_dir: str = MISSING


REFUSAL = {"refusal": {"_target_": "coil_rl.programs.refusal.Refusal"}}
ConfigStore.instance().store(group="hydra/callbacks", name="refusal", node=REFUSAL)
ConfigStore.instance().store(name="schema", node=Train)
ConfigStore.instance().store(name="evaluate_schema", node=Evaluate)
ConfigStore.instance().store(name="report_schema", node=Report)
ConfigStore.instance().store(name="listen_schema", node=Listen)
ConfigStore.instance().store(name="replay_schema", node=Replay)
ConfigStore.instance().store(name="robot_schema", node=Robot)
ConfigStore.instance().store(name="reproduce_schema", node=Reproduce)
