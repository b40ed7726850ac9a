"""PI controllers of the heater: a Python class, a batched module with memory, and functions."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer


class PI:
    """Integrates only while the heater is not at its limit (anti-windup).

    Args:
        kp: power per K.
        ki: power per K and step.
    """

    def __init__(self, kp: float = 0.2, ki: float = 0.02) -> None:
        self.kp, self.ki, self.integral = kp, ki, 0.0

    def reset(self) -> None:
        """Forget the last day."""
        self.integral = 0.0

    def act(self, observation: NDArray[np.float32]) -> list[float]:
        """Return the power [1]."""
        cold = -float(observation[0])
        power = min(max(self.kp * cold + self.integral, 0.0), 1.0)
        if 0 < power < 1:
            self.integral += self.ki * cold
        return [power]

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint needs."""
        return {"integral": self.integral}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from such a state."""
        self.integral = state["integral"]


class BatchedPI(TensorDictModuleBase):
    """The same for all rooms at once.

    Its integral follows what the heater was really given (back-calculation).

    So it does not wind up either while an agent heats instead of it.

    Args:
        kp: power per K.
        ki: power per K and step.
        tracking: share of the difference to the given power that the integral follows in a step.
    """

    def __init__(self, kp: float = 0.2, ki: float = 0.02, tracking: float = 0.5) -> None:
        self.in_keys = ["observation", "last_action", "integral", "wish"]
        self.out_keys = ["action", ("next", "integral"), ("next", "wish")]
        super().__init__()
        self.kp, self.ki, self.tracking = kp, ki, tracking

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` [B, 1]."""
        cold = -tensordict["observation"][..., :1]
        integral = tensordict["integral"] + self.tracking * (
            tensordict["last_action"] - tensordict["wish"]
        )
        wish = self.kp * cold + integral
        tensordict.set("action", wish.clamp(0, 1))
        return tensordict.set(("next", "integral"), integral + self.ki * cold).set(
            ("next", "wish"), wish
        )

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Declare the memory, 0 at the start of each episode."""
        return TensorDictPrimer(
            {"integral": Unbounded((1,)), "wish": Unbounded((1,))}, expand_specs=True
        )


def proportional(observation: Tensor, kp: float = 0.2) -> Tensor:
    """Return the power [B, 1] for observations [B, 2], without memory."""
    return (-kp * observation[..., :1]).clamp(0, 1)


class Feedforward(torch.nn.Linear):
    """A network: the power [B, 1] for observations [B, 2], and for the temperature outside."""

    def __init__(self) -> None:
        super().__init__(2, 1)
        with torch.no_grad():
            self.weight.copy_(torch.tensor([[-0.2, -0.03]]))
            self.bias.fill_(0.6)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the power."""
        return super().forward(observation).clamp(0, 1)


class KnowsTheDay:
    """A controller beside its env: it reads the mean temperature outside from the env itself."""

    def __init__(self, env: Any) -> None:
        self.room = env.unwrapped

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the power [1]."""
        needed = 0.6 - 0.03 * self.room.mean - 0.2 * observation[:1]
        return np.clip(needed, 0, 1)
