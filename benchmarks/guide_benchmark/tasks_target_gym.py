"""A stirred tank reactor of target-gym with its own PID, and the export of results to target-gym.

    python -m pip install jax flax chex optax imageio seaborn
    python -m pip install --no-deps target-gym==0.6.1 "gymnax>=1" "do-mpc<6" "casadi<3.8" \
        pygame-ce moviepy proglog decorator python-dotenv imageio-ffmpeg

The second without dependencies, because target-gym asks for a Gymnasium below 1.4. The export
writes into the installed package, in the form of its results of learned policies:

    python -m benchmarks.guide_benchmark.tasks_target_gym outputs/experiments/guide_benchmark
"""

import argparse
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
from numpy.typing import NDArray
from target_gym.experts.pid import StatefulPID, make_cstr_pid
from target_gym.pc_gym.cstr.env_jax import CSTR
from target_gym.rl_results import record_result
from target_gym.wrapper import gym_wrapper_factory

from benchmarks.promise import arms_of
from coil_rl.report import read_runs

Wrapped: Any = gym_wrapper_factory(CSTR)


class Reactor(Wrapped):
    """The reactor, with a new episode at each reset without a seed, which the wrapper repeats."""

    key: Any

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin an episode."""
        self.key, _ = jax.random.split(self.key)
        return super().reset(seed=seed, options=options)


class PID:
    """The PID of target-gym.

    Args:
        gain: factor of its three gains.
    """

    def __init__(self, gain: float = 1.0) -> None:
        own, _ = make_cstr_pid()
        gains = [gain * float(each) for each in (own.Kp, own.Ki, own.Kd)]
        self.rule = StatefulPID(*gains, dt=own.dt, state_index=0, setpoint_index=2)

    def reset(self) -> None:
        """Forget the last episode."""
        self.rule.reset()

    def act(self, observation: NDArray) -> list[float]:
        """Return the temperature of the coolant [1], from -1 to 1."""
        return [float(self.rule.step(observation))]


def main() -> None:
    """Record the returns of the benchmark's reactor, one for each seed, in target-gym."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the experiments, with the folder `reactor`")
    for (method, name), arm in arms_of(read_runs([parser.parse_args().folder / "reactor"])).items():
        record = record_result(
            env="cstr",
            algorithm=f"{method}_{name}",
            library="coil-rl",
            library_version=metadata.version("coil-rl"),
            returns=[arm.reward(seed) for seed in sorted(arm.runs)],
            episode_steps=100,
            total_timesteps=int(max(run.curve[-1]["frames"] for run in arm.runs.values())),
        )
        print(f"{record['env']}, {record['algorithm']}: {record['returns']}")


if __name__ == "__main__":
    main()
