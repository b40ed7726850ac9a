"""Truncation of episodes that nothing else ends, of envs of Gymnasium and TorchRL.

Without one, an env that never ends is evaluated for ever before the first update.
"""

import math
import warnings
from collections.abc import Iterator
from numbers import Real
from typing import Any

import gymnasium
from gymnasium.wrappers import TimeLimit
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, StepCounter, TransformedEnv

from coil_rl.envs.seeded_env import SeededEnv

LIMIT = 1_000  # steps
# Attributes in which envs keep the largest number of steps of an episode themselves.
NAMES = ("max_steps", "max_episode_steps", "_max_episode_steps", "horizon", "episode_length")
SECONDS = "time_limit"  # name of the longest time of an episode of a TorchRL env


def limit_of(env: Any) -> int | None:
    """Return the number of steps after which an episode is truncated; None: something else ends it.

    A StepCounter, a TimeLimit, a registered number and a `time_limit` of a TorchRL env in seconds
    are believed. Another attribute may be another thing than it seems, such as the horizon of a
    predictive controller. So it only makes the limit longer.

    Args:
        env: of Gymnasium or TorchRL, with its wrappers or transforms.
    """
    of_torchrl = isinstance(env, EnvBase)
    if of_torchrl and any(
        isinstance(part, StepCounter) and part.max_steps for part in env.modules()
    ):
        return None
    limit = LIMIT
    for layer in layers(env):
        registered = getattr(getattr(layer, "spec", None), "max_episode_steps", None)
        if isinstance(layer, TimeLimit) or _is_number(registered):
            return None
        if of_torchrl and _is_number(getattr(layer, SECONDS, None)):
            return None
        for value in (getattr(layer, name, None) for name in NAMES):
            if isinstance(value, Real) and math.isfinite(value):
                limit = max(limit, math.ceil(float(value)))
    return limit


def layers(env: Any) -> Iterator[Any]:
    """Yield an env without its transforms, and what is in its wrappers."""
    layer, of_torchrl = _base(env), isinstance(env, EnvBase)
    for _ in range(100):
        yield layer
        inside = getattr(layer, "_env", getattr(layer, "env", None))
        # A Gymnasium env without a wrapper may hold an env that does not end its own episodes.
        if inside is None or not (of_torchrl or isinstance(layer, gymnasium.Wrapper)):
            return
        layer = inside


def _base(env: Any) -> Any:
    """Return an env without its transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def warn_of_limit(name: str, limit: int, wrapper: str) -> None:
    """Warn that the episodes of an env are truncated.

    Args:
        limit: the number of steps.
        wrapper: or transform that could have ended them.
    """
    warnings.warn(
        f"an episode of the env {name} did not end within {limit:,} steps, and no {wrapper} ends "
        f"it: episodes are truncated there (env.max_steps=NUMBER, or a {wrapper} of yours, sets "
        "another limit)",
        stacklevel=3,
    )


class StepLimit(StepCounter):
    """Truncates the episodes of a batched env after a number of steps, and says so the first time.

    Args:
        name: of the env, for the warning.
        limit: the number of steps.
    """

    def __init__(self, name: str, limit: int) -> None:
        super().__init__(limit, step_count_key="limit_count")
        self.name, self.said = name, False

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        after = super()._step(tensordict, next_tensordict)
        if not self.said:
            counts = [after[key] for key in self.step_count_keys]
            if any(bool((count >= self.max_steps).any()) for count in counts):
                self.said = True
                warn_of_limit(self.name, self.max_steps, StepCounter.__name__)
        return after


def limits_of(env: EnvBase) -> list[StepLimit]:
    """Return the transform that limits the episodes of a foreign env, if nothing else ends them.

    Args:
        env: of any batch size. The envs of coil-rl have limits of their own.
    """
    limit = None if isinstance(_base(env), SeededEnv) else limit_of(env)
    return [] if limit is None else [StepLimit(type(_base(env)).__name__, limit)]
