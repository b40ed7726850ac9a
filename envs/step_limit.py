"""A largest number of steps for episodes of TorchRL envs that name none.

Without one, an env that never ends is evaluated for ever before the first update.
"""

import warnings
from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import EnvBase, StepCounter, TransformedEnv

from coil_rl.envs.gate import LIMIT, OWN_LIMITS
from coil_rl.envs.seeded_env import SeededEnv

# Names of the largest number of steps, or of seconds, of an episode.
NAMES = (*OWN_LIMITS, "episode_length", "time_limit")


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
                    "put TorchRL's StepCounter(NUMBER) around it, or give it the attribute "
                    "max_steps, for another limit",
                )
        return after


def warn_of_limit(name: str, limit: int, remedy: str) -> None:
    """Say that the episodes of an env are truncated.

    Args:
        name: of the env.
        limit: the number of steps.
        remedy: how to set another limit.
    """
    warnings.warn(
        f"the env {name} names no largest number of steps, and an episode did not end within "
        f"{limit:,}: episodes are truncated there ({remedy})",
        stacklevel=3,
    )


def limits_of(env: EnvBase) -> list[StepLimit]:
    """Return the transform that limits the episodes of a foreign env that names no limit.

    Args:
        env: of any batch size. The envs of coil-rl have limits of their own.
    """
    if isinstance(_base(env), SeededEnv) or names_limit(env):
        return []
    return [StepLimit(type(_base(env)).__name__)]


def names_limit(env: EnvBase) -> bool:
    """Return whether an env names the largest number of steps of an episode.

    Args:
        env: it may have transforms, or be a wrapper of an env of another library.
    """
    if any(isinstance(part, StepCounter) and part.max_steps for part in env.modules()):
        return True
    layer: Any = _base(env)
    for _ in range(100):  # layers of wrappers
        numbers = [getattr(layer, name, None) for name in NAMES]
        spec = getattr(getattr(layer, "spec", None), "max_episode_steps", None)
        if any(_is_number(number) for number in (*numbers, spec)):
            return True
        inside = getattr(layer, "_env", getattr(layer, "env", None))
        if inside is None:
            return False
        layer = inside
    return False


def _base(env: EnvBase) -> EnvBase:
    """Return an env without its transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
