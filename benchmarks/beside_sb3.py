"""Our learners beside those of Stable-Baselines3.

Both train with the same hyper-parameters and frames on the same Gymnasium envs.

    python -m benchmarks.beside_sb3 ppo Pendulum-v1 --frames 40000 --seeds 3

prints for both the mean return of deterministic episodes with fixed seeds after the training, with
the standard deviation over the runs, the frames per CPU second of the training, and the gradient
steps per CPU second of the updates alone. The extra `bench` of coil-rl installs what it needs.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pandas as pd
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import (
    Compose,
    EnvBase,
    ExplorationType,
    TransformedEnv,
    set_exploration_type,
)
from tqdm import tqdm

from benchmarks.timing import Stopwatch
from coil_rl.foreign.gymnasium_env import GymnasiumEnv
from coil_rl.learners import DQN, PPO, SAC, Mlp
from coil_rl.report import markdown_table
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.run.rollout import Rollout
from coil_rl.schedules import Linear
from coil_rl.transforms.normalised_action import given_units, normalising

Act = Callable[[Tensor], Tensor]  # observations [B, D] to deterministic actions
# Values of an algorithm on any env, with `every` frames to a minibatch; and what differs on some,
# as tuned for Stable-Baselines3 by RL Zoo.
VALUES: Mapping[str, Mapping[str, Any]] = {
    "ppo": {
        "envs": 8,
        "steps": 256,
        "minibatch": 64,
        "epochs": 10,
        "learning_rate": 3e-4,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "entropy": 0.0,
    },
    "sac": {
        "envs": 1,
        "steps": 1,
        "every": 1,
        "minibatch": 256,
        "learning_rate": 1e-3,
        "gamma": 0.99,
        "tau": 0.005,
        "starts": 1_000,
        "hidden": (64, 64),
    },
    "dqn": {
        "envs": 1,
        "steps": 4,
        "every": 4,
        "minibatch": 128,
        "learning_rate": 6e-4,
        "gamma": 0.99,
        "tau": 0.01,
        "starts": 1_000,
        "hidden": (128, 128),
        "explore": 0.3,
        "epsilon": 0.05,
    },
}
LANDER = {
    "envs": 16,
    "steps": 1024,
    "epochs": 4,
    "gamma": 0.999,
    "gae_lambda": 0.98,
    "entropy": 0.01,
}
TUNED: Mapping[tuple[str, str], Mapping[str, Any]] = {
    ("ppo", "Pendulum-v1"): {"envs": 4, "steps": 1024, "learning_rate": 1e-3, "gamma": 0.9},
    ("ppo", "LunarLander-v3"): LANDER,
    ("ppo", "LunarLanderContinuous-v3"): LANDER,
}
CAPACITY = 50_000
EPISODES, FIRST_SEED = 20, 100_000  # of the evaluation


def ours(
    algorithm: str, env_id: str, values: Mapping[str, Any], frames: int, seed: int
) -> tuple[Act, float]:
    """Train our learner.

    Args:
        algorithm: "ppo", "sac" or "dqn".
        env_id: Gymnasium's name of the env.
        values: hyper-parameters, see `VALUES`.
        seed: of the env and of the learner.

    Returns:
        The deterministic policy, and the gradient steps per CPU second of the updates.
    """
    learner, rollout, stopwatch = our_training(algorithm, env_id, values, seed)
    units, steps = given_units(rollout.env), 0.0
    for count in range(frames // rollout.frames):
        metrics = learner.update(rollout.collect(), count * rollout.frames / frames)
        epochs = values.get("epochs", 0)
        steps += metrics.get("minibatches", epochs * rollout.frames / values["minibatch"])

    def act(observation: Tensor) -> Tensor:
        state = TensorDict({"observation": observation}, observation.shape[:1])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            action: Tensor = learner.policy(state)["action"]
        return action if units is None else units.denormalise(action)

    return act, per_second(steps, stopwatch)


def our_training(
    algorithm: str, env_id: str, values: Mapping[str, Any], seed: int
) -> tuple[PPO | SAC | DQN, Rollout, Stopwatch]:
    """Return our learner, its rollout and the CPU time of its updates; see `ours`."""
    torch.manual_seed(seed)
    env = normalised_env(env_id, values["envs"], seed)
    learner = our_learner(algorithm, env, values, seed)
    rollout = Rollout(env, learner.policy, values["steps"], learner.keys)
    return learner, rollout, updates_of(learner, "update")


def normalised_env(env_id: str, envs: int, seed: int = 0) -> EnvBase:
    """Return an env of Gymnasium, whose actions are between -1 and 1 where they are numbers."""
    env = GymnasiumEnv(env_id, envs, seed=seed)
    first = normalising(env)
    return TransformedEnv(env, Compose(*first)) if first else env


def our_learner(
    algorithm: str, env: EnvBase, values: Mapping[str, Any], seed: int
) -> PPO | SAC | DQN:
    """Return our learner with the values of Stable-Baselines3; see `ours`."""
    common: dict[str, Any] = {
        "learning_rate": values["learning_rate"],
        "gamma": values["gamma"],
        "seed": seed,
    }
    if algorithm == "ppo":
        return PPO(
            env,
            hidden=(64, 64),
            action_scale=1.0,
            squash=False,
            gae_lambda=values["gae_lambda"],
            epochs=values["epochs"],
            minibatches=values["envs"] * values["steps"] // values["minibatch"],
            entropy=values["entropy"],
            **common,
        )
    common |= {
        "network": Mlp(values["hidden"], "relu"),
        "tau": values["tau"],
        "starts": values["starts"],
        "capacity": CAPACITY,
        "batch_size": values["minibatch"],
        "updates_per_step": 1 / values["every"],
    }
    if algorithm == "sac":
        # The default of Stable-Baselines3 is for actions in [-1, 1], ours for those of the env.
        high, size = env.action_spec.space.high, env.action_spec.shape[-1]
        entropy = -size + size * math.log(float(high.max()))
        return SAC(env, target_entropy=entropy, temperature=1.0, **common)
    epsilon = Linear(1.0, values["epsilon"], until=values["explore"])
    return DQN(env, epsilon=epsilon, double=False, **common)


def theirs(
    algorithm: str, env_id: str, values: Mapping[str, Any], frames: int, seed: int
) -> tuple[Act, float]:
    """Train the learner of Stable-Baselines3; see `ours`."""
    model, stopwatch = their_training(algorithm, env_id, values, seed)
    model.learn(frames)
    steps = model._n_updates
    if algorithm == "ppo":  # which counts epochs
        steps *= values["envs"] * values["steps"] / values["minibatch"]

    def act(observation: Tensor) -> Tensor:
        return torch.from_numpy(model.predict(observation.numpy(), deterministic=True)[0])

    return act, per_second(steps, stopwatch)


def their_training(
    algorithm: str, env_id: str, values: Mapping[str, Any], seed: int
) -> tuple[Any, Stopwatch]:
    """Return the learner of Stable-Baselines3 and the CPU time of its updates; see `ours`."""
    from stable_baselines3.common.env_util import make_vec_env

    # Its default, rgb_array, makes LunarLander slower and slower: particles are added, but no
    # picture removes them.
    envs = make_vec_env(env_id, values["envs"], seed=seed, env_kwargs={"render_mode": None})
    model = their_learner(algorithm, envs, values, seed)
    return model, updates_of(model, "train")


def their_learner(algorithm: str, envs: Any, values: Mapping[str, Any], seed: int) -> Any:
    """Return the learner of Stable-Baselines3 for its vector of envs; see `ours`."""
    import stable_baselines3

    common: dict[str, Any] = {
        "learning_rate": values["learning_rate"],
        "gamma": values["gamma"],
        "batch_size": values["minibatch"],
        "seed": seed,
        "device": "cpu",
    }
    if algorithm == "ppo":
        return stable_baselines3.PPO(
            "MlpPolicy",
            envs,
            n_steps=values["steps"],
            n_epochs=values["epochs"],
            gae_lambda=values["gae_lambda"],
            ent_coef=values["entropy"],
            **common,
        )
    common |= {
        "tau": values["tau"],
        "learning_starts": values["starts"],
        "buffer_size": CAPACITY,
        "train_freq": values["steps"],
        "gradient_steps": values["envs"] * values["steps"] // values["every"],
        "policy_kwargs": {"net_arch": list(values["hidden"]), "activation_fn": nn.ReLU},
    }
    if algorithm == "sac":
        return stable_baselines3.SAC("MlpPolicy", envs, **common)
    return stable_baselines3.DQN(
        "MlpPolicy",
        envs,
        target_update_interval=values["every"],
        exploration_fraction=values["explore"],
        exploration_final_eps=values["epsilon"],
        **common,
    )


def updates_of(learner: object, method: str) -> Stopwatch:
    """Return a stopwatch of the CPU time of a method of a learner."""
    stopwatch = Stopwatch(time.process_time)
    stopwatch.wrap(learner, method, "updates")
    return stopwatch


def per_second(steps: float, stopwatch: Stopwatch) -> float:
    """Return gradient steps per second of the updates; NaN without any."""
    return steps / stopwatch.seconds["updates"] if steps else math.nan


def mean_return(env_id: str, act: Act) -> float:
    """Return the mean return of one episode from each of the fixed seeds."""
    env = GymnasiumEnv(env_id, EPISODES, first_seed=FIRST_SEED)

    def policy(state: TensorDictBase) -> TensorDictBase:
        return state.set("action", act(state["observation"]))

    return evaluate_policy(env, policy).mean_reward


def main(argv: Sequence[str] | None = None) -> None:
    """Train with both and print the comparison."""
    parser = argparse.ArgumentParser("python -m benchmarks.beside_sb3", description=__doc__)
    parser.add_argument("algorithm", choices=list(VALUES))
    parser.add_argument("env", help="a Gymnasium id, e.g. Pendulum-v1 or LunarLanderContinuous-v3")
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--seeds", type=int, default=3, help="runs, with the seeds 0, 1, ...")
    parser.add_argument("--envs", type=int, help="number of envs, if not that of the algorithm")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    values = {**VALUES[args.algorithm], **TUNED.get((args.algorithm, args.env), {})}
    values["envs"] = args.envs or values["envs"]
    learners = {"ours": ours, "Stable-Baselines3": theirs}
    runs = []
    # In turns, so that a machine that becomes slower or faster is so for both.
    turns = list(itertools.product(range(args.seeds), learners.items()))
    for seed, (name, train) in tqdm(turns, disable=None):
        start = time.process_time()
        act, steps = train(args.algorithm, args.env, values, args.frames, seed)
        rate = args.frames / (time.process_time() - start)
        runs.append({"": name, "return": mean_return(args.env, act), "rate": rate, "steps": steps})
    columns = {
        "return": ("return", "mean"),
        "sd": ("return", "std"),
        "frames per CPU s": ("rate", "median"),
        "gradient steps per CPU s": ("steps", "median"),
    }
    table = pd.DataFrame(runs).groupby("", sort=False).agg(**columns).reset_index()
    print(f"{args.algorithm}, {args.env}, {args.frames} frames, {args.seeds} runs, {values}")
    print(markdown_table(table.to_dict("records"), {name: (name, ".0f") for name in table}))


if __name__ == "__main__":
    main()
