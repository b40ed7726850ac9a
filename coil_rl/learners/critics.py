"""Critics of actions as one module, for policies and losses that compare values of actions."""

import copy
from typing import Self

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import REDQLoss, SACLoss


class Critics(TensorDictModuleBase):
    """The critics of a loss of TorchRL, all at once.

    They read entries that have been normalised already. As a module it writes their uncertainty:
    the standard deviation of the values of an action, in the unit of the return, as `("next",
    "uncertainty")` [*B, 1].

    Args:
        loss: has the critics.
        weights: of the critics, perhaps those of the target networks; None: those that learn.
    """

    def __init__(self, loss: SACLoss | REDQLoss, weights: TensorDictBase | None = None) -> None:
        # Without weights; a tuple, so that it is no submodule.
        self._network = (loss.qvalue_network,)
        self.in_keys: list[NestedKey] = list(loss.qvalue_network.in_keys)
        self.out_keys: list[NestedKey] = [("next", "uncertainty")]
        super().__init__()
        self.weights = loss.qvalue_network_params if weights is None else weights
        self.networks: nn.ModuleList | None = None  # written out, one for each critic

    def written_out(self) -> Self:
        """Return a copy in which each critic is a network of its own, for export."""
        copied = copy.deepcopy(self)
        (network,) = self._network
        copied.networks = nn.ModuleList()
        for weights in self.weights.data.unbind(0):
            own = copy.deepcopy(network)
            weights.to_module(own)
            copied.networks.append(own)
        del copied.weights
        return copied

    def values(self, tensordict: TensorDictBase) -> Tensor:
        """Return the values of the action, [critics, *B]."""
        (network,) = self._network
        data = tensordict.select(*network.in_keys)
        if self.networks is not None:
            values = [each(data.copy())["state_action_value"] for each in self.networks]
            return torch.stack(values).squeeze(-1)

        def one(weights: TensorDictBase) -> Tensor:
            with weights.to_module(network):
                value: Tensor = network(data.copy())["state_action_value"]
            return value

        return torch.vmap(one)(self.weights).squeeze(-1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the uncertainty for the next step of the env."""
        return tensordict.set(("next", "uncertainty"), self.values(tensordict).std(0).unsqueeze(-1))
