"""A gated recurrent unit, written out: TorchRL's module cannot be exported."""

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn import functional as F
from torchrl.modules import GRUModule


class WrittenGru(TensorDictModuleBase):
    """One step of a `GRUModule` of one layer, with the same weights.

    The state that it reads is that of the step before; whoever begins an episode sets it to 0.

    Args:
        module: the module.
    """

    def __init__(self, module: GRUModule) -> None:
        super().__init__()
        observed, state, _ = module.in_keys
        self.in_keys, self.out_keys = [observed, state], list(module.out_keys)
        self.gru = module.gru

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what is remembered, and the next state."""
        observed, state = (tensordict[key] for key in self.in_keys)
        remembered = self.step(observed, state.squeeze(-2))
        written, after = self.out_keys
        return tensordict.set(written, remembered).set(after, remembered.unsqueeze(-2))

    def step(self, observed: Tensor, state: Tensor) -> Tensor:
        """Return the next state [B, H].

        Args:
            observed: [B, N].
            state: [B, H].
        """
        gru = self.gru
        inputs = F.linear(observed, gru.weight_ih_l0, gru.bias_ih_l0)
        hidden = F.linear(state, gru.weight_hh_l0, gru.bias_hh_l0)
        (reset, update, new), (of_reset, of_update, of_new) = (
            each.chunk(3, -1) for each in (inputs, hidden)
        )
        keep = (update + of_update).sigmoid()
        fresh = (new + (reset + of_reset).sigmoid() * of_new).tanh()
        return (1 - keep) * fresh + keep * state
