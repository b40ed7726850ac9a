"""Updates per CPU second of the learners with replay, beside Stable-Baselines3 and SBX."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec

import torch

from benchmarks.beside_sb3 import normalised_env
from benchmarks.timing import Row, Work, measure, median_ratio, medians
from coil_rl.learners import DQN, SAC, TQC, CrossQ, Mlp
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.run.rollout import Rollout

LEARNERS: dict[str, type[OffPolicy]] = {"SAC": SAC, "CrossQ": CrossQ, "TQC": TQC, "DQN": DQN}
SIZES = ((64, (64, 64)), (256, (64, 64)), (256, (256, 256)))  # batch and hidden layers
STORED = 1_000  # steps, of which minibatches are drawn
UPDATES = 32  # of a call


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
            rates = measure(args, subjects, time.process_time)
            row: Row = {"learner": name, "batch": batch, "hidden": "-".join(map(str, hidden))}
            row |= {f"{each} (updates/s)": rate for each, rate in medians(rates).items()}
            for each in rates.keys() - {"sb3"} if "sb3" in rates else ():
                row[f"{each} / sb3"] = median_ratio(rates[each], rates["sb3"])
            rows.append({**row, "rounds": rates})
    return rows


def env_of(name: str) -> str:
    """Return Gymnasium's name of an env for a learner."""
    return "CartPole-v1" if name == "DQN" else "Pendulum-v1"


def ours(name: str, batch: int, hidden: Sequence[int], *, compiled: bool) -> Work:
    """Return updates of our learner."""
    torch.manual_seed(0)
    env = normalised_env(env_of(name), 4)
    learner = LEARNERS[name](  # type: ignore[call-arg]
        env, network=Mlp(hidden, "relu"), batch_size=batch, starts=STORED, compile=compiled
    )
    rollout = Rollout(env, learner.policy, STORED // 4, learner.keys)
    learner.store(rollout.collect())
    weights = learner.loss_weights(0.0)
    learner.gradient.begin(0.0)

    def work() -> int:
        learner.pending_updates = UPDATES
        for minibatch in learner.samples():
            learner.gradient(minibatch, weights)
        return UPDATES

    return work


def theirs(package: str, name: str, batch: int, hidden: Sequence[int]) -> Work:
    """Return updates of the learner of a package."""
    model = getattr(import_module(package), name)(
        "MlpPolicy",
        env_of(name),
        batch_size=batch,
        learning_starts=STORED,
        policy_kwargs={"net_arch": list(hidden)},
        device="cpu",
        seed=0,
    )
    model.learn(STORED)

    def work() -> int:
        model.train(UPDATES, batch)
        return UPDATES

    return work
