"""Updates per CPU second of the learners with replay, beside Stable-Baselines3 and SBX."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec

import torch
from torchrl.envs import Compose, EnvBase, TransformedEnv

from benchmarks.timing import Row, median_ratio, medians
from coil_rl.foreign.gymnasium_env import GymnasiumEnv
from coil_rl.learners import DQN, SAC, TQC, CrossQ, Mlp
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.run.rollout import Rollout
from coil_rl.transforms.normalised_action import normalising

Work = Callable[[int], object]  # takes that many updates
LEARNERS: dict[str, type[OffPolicy]] = {"SAC": SAC, "CrossQ": CrossQ, "TQC": TQC, "DQN": DQN}
SIZES = ((64, (64, 64)), (256, (64, 64)), (256, (256, 256)))  # batch and hidden layers
STORED = 1_000  # steps, of which minibatches are drawn


def measure_replay(args: Namespace) -> list[Row]:
    """Return a row for each learner and size: updates per CPU second, on one core.

    In every round each has its turn, and the ratios are medians over the rounds. Replay, losses,
    optimiser and target networks are included, steps of the env are not.
    """
    rows = []
    for name in LEARNERS:
        for batch, hidden in SIZES[: args.replay_sizes]:
            subjects = {"ours": ours(name, batch, hidden, compiled=False)}
            if args.compile_updates:
                subjects["ours, compiled"] = ours(name, batch, hidden, compiled=True)
            for package, label in (("stable_baselines3", "sb3"), ("sbx", "sbx")):
                if find_spec(package) and hasattr(import_module(package), name):
                    subjects[label] = theirs(package, name, batch, hidden)
            sizes = {"learner": name, "batch": batch, "hidden": "-".join(map(str, hidden))}
            rows.append({**sizes, **compared(args, subjects)})
    return rows


def compared(args: Namespace, subjects: dict[str, Work]) -> Row:
    """Return the speeds of all subjects, and the ratios to Stable-Baselines3."""
    rates: dict[str, list[float]] = {name: [] for name in subjects}
    for work in subjects.values():
        work(args.replay_updates)
    for _ in range(args.repeats):
        for name, work in subjects.items():
            start = time.process_time()
            work(args.replay_updates)
            rates[name].append(args.replay_updates / (time.process_time() - start))
    row: Row = {f"{name} (updates/s)": rate for name, rate in medians(rates).items()}
    for name in rates.keys() - {"sb3"} if "sb3" in rates else ():
        row[f"{name} / sb3"] = median_ratio(rates[name], rates["sb3"])
    return {**row, "rounds": rates}


def env_of(name: str) -> str:
    """Return Gymnasium's name of an env for a learner."""
    return "CartPole-v1" if name == "DQN" else "Pendulum-v1"


def ours(name: str, batch: int, hidden: Sequence[int], *, compiled: bool) -> Work:
    """Return updates of our learner."""
    torch.manual_seed(0)
    env: EnvBase = GymnasiumEnv(env_of(name), 4)
    if first := normalising(env):
        env = TransformedEnv(env, Compose(*first))
    learner = LEARNERS[name](  # type: ignore[call-arg]
        env, network=Mlp(hidden, "relu"), batch_size=batch, starts=STORED, compile=compiled
    )
    rollout = Rollout(env, learner.policy, STORED // 4, learner.keys)
    learner.store(rollout.collect())
    weights = learner.loss_weights(0.0)
    learner.gradient.begin(0.0)

    def work(updates: int) -> None:
        learner.pending_updates = updates
        for minibatch in learner.samples():
            learner.gradient(minibatch, weights)

    return work


def theirs(package: str, name: str, batch: int, hidden: Sequence[int]) -> Work:
    """Return updates of the learner of a package."""
    options: dict[str, object] = {"policy_kwargs": {"net_arch": list(hidden)}}
    model = getattr(import_module(package), name)(
        "MlpPolicy",
        env_of(name),
        batch_size=batch,
        learning_starts=STORED,
        device="cpu",
        seed=0,
        **options,
    )
    model.learn(STORED)
    return lambda updates: model.train(updates, batch)
