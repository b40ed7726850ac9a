"""Truncation of the episodes of TorchRL envs that nothing else ends.

Without one, an env that never ends is evaluated for ever before the first update.
"""

from numbers import Real
from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import EnvBase, StepCounter, TransformedEnv

from coil_rl.envs.seeded_env import SeededEnv
from coil_rl.foreign.faults import LIMIT, OWN_LIMITS, limit_by_attributes, warn_of_limit

NAMES = (*OWN_LIMITS, "episode_length")  # of the largest number of steps of an episode
COUNTER = StepCounter.__name__
SECONDS = "time_limit"  # name of the longest time of an episode


class StepLimit(StepCounter):
    """Truncates episodes after a number of steps, and says so the first time.

    Args:
        name: of the env, for the warning.
        limit: the number of steps.
    """

    def __init__(self, name: str, limit: int = LIMIT) -> None:
        super().__init__(limit, step_count_key="limit_count")
        self.name, self.said = name, False

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        after = super()._step(tensordict, next_tensordict)
        if not self.said:
            counts = [after[key] for key in self.step_count_keys]
            if any(bool((count >= self.max_steps).any()) for count in counts):
                self.said = True
                warn_of_limit(
                    self.name,
                    self.max_steps,
                    COUNTER,
                    f"put TorchRL's {COUNTER}(NUMBER) around it for another limit",
                )
        return after


def limits_of(env: EnvBase) -> list[StepLimit]:
    """Return the transform that limits the episodes of a foreign env, if nothing else ends them.

    Args:
        env: of any batch size. The envs of coil-rl have limits of their own.
    """
    limit = None if isinstance(_base(env), SeededEnv) else limit_of(env)
    return [] if limit is None else [StepLimit(type(_base(env)).__name__, limit)]


def limit_of(env: EnvBase) -> int | None:
    """Return the number of steps after which an episode is truncated; None: something else ends it.

    A StepCounter, a limit of Gymnasium and a `time_limit` in seconds are believed. Other attributes
    make the limit longer, see `limit_by_attributes`.

    Args:
        env: it may have transforms, or be a wrapper of an env of another library.
    """
    if any(isinstance(part, StepCounter) and part.max_steps for part in env.modules()):
        return None
    limit = LIMIT
    layer: Any = _base(env)
    for _ in range(100):  # layers of wrappers
        spec = getattr(getattr(layer, "spec", None), "max_episode_steps", None)
        if _is_number(spec) or _is_number(getattr(layer, SECONDS, None)):
            return None
        limit = max(limit, limit_by_attributes(layer, NAMES))
        inside = getattr(layer, "_env", getattr(layer, "env", None))
        if inside is None:
            break
        layer = inside
    return limit


def _base(env: EnvBase) -> EnvBase:
    """Return an env without its transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)
