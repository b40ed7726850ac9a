"""Batches of single envs in one process, whose running episodes are saved as seeds and actions.

Most envs of other people are single and cannot save their state. But nearly all are deterministic
once they are seeded. So every episode gets a seed of its own, and its actions are remembered: a
resumed run begins the episode again and repeats the actions.
"""

import warnings
from abc import abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv

from coil_rl.envs.seeded_env import SeededEnv
from coil_rl.foreign.rows import Entries, Rows
from coil_rl.foreign.workers import Workers

SEEDS = 2**31  # seeds of drawn episodes are below
REMEMBERED = 20_000  # steps; a longer episode is not repeated when a state is restored


class SeededRows(SeededEnv):
    """Base of batched envs made of single ones; every episode begins with a seed of its own.

    `state_dict` holds the generator and, for each running episode, its seed and actions.
    `load_state_dict` repeats these actions: a deterministic env goes on to the bit. `continues`
    says whether it did. If not, because the last observations differ or an episode is longer than
    20,000 steps, a warning is given, and the env must be reset.

    Args:
        shard: the single envs.
        count: B, number of rows.
        seed: of the draw of the episodes' seeds, at least 0.
        first_seed: row i begins all its episodes with the seed `first_seed + i % cases`; None to
            draw the seeds.
        cases: number of different episodes, by default that of the rows; needs `first_seed`.
        device: of all tensors.

    Raises:
        ValueError: for `cases` without `first_seed`.
    """

    remedy: ClassVar[str] = ""  # what may help if running episodes cannot be repeated
    optional: Sequence[tuple[str, str]] = ()  # entries that may lack a number

    def __init__(
        self,
        shard: Rows[Any] | Workers,
        count: int,
        seed: int,
        first_seed: int | None,
        cases: int | None,
        device: torch.device | str,
    ) -> None:
        if cases is not None and first_seed is None:
            raise ValueError(f"cases={cases} needs first_seed, the seed of the first case")
        super().__init__(device=torch.device(device), batch_size=torch.Size([count]))
        self.shard: Rows[Any] | Workers = shard
        self.first_seed, self.cases = first_seed, cases or count
        self.parts: list[Entries] = []  # of all rows, as the processes returned them
        self.generator = torch.Generator()
        self.seeds: list[int] = []  # of the running episodes; none before the first reset
        self.ages = np.zeros(count, dtype=np.int64)  # steps since the reset
        self.actions: deque[NDArray[Any]] = deque(maxlen=REMEMBERED)
        self.continues = True
        self.set_seed(seed)

    @abstractmethod
    def _decode(self, actions: NDArray[Any]) -> Any:
        """Return actions [..., B, *A] as the rows take them, with the same leading dimensions."""

    @abstractmethod
    def _output(self, *, stepped: bool) -> TensorDict:
        """Return the entries of all rows after a reset, or after a step."""

    def begin(
        self, seeds: Mapping[int, int], actions: Mapping[int, Sequence[Any]] | None = None
    ) -> None:
        """Begin episodes, see `Rows`."""
        self.parts[:] = self.shard.begin(seeds, actions or {})

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None or not self.seeds else tensordict.get("_reset", None)
        count = self.batch_size[0]
        # One draw per row, reset or not, keeps the random sequence independent of the data.
        seeds = [(self.first_seed or 0) + row % self.cases for row in range(count)]
        if self.first_seed is None:
            seeds = self._drawn(SEEDS).tolist()
        self.seeds = self.seeds or seeds
        ended = list(range(count))
        if mask is not None:
            ended = mask.view(-1).nonzero().view(-1).tolist()
        self.begin({row: seeds[row] for row in ended})
        for row in ended:
            self.seeds[row], self.ages[row] = seeds[row], 0
        while len(self.actions) > self.ages.max():
            self.actions.popleft()
        return self._output(stepped=False)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict[self.action_key].detach().cpu().numpy().copy()
        self.actions.append(actions)
        np.add(self.ages, 1, out=self.ages)  # PyTorch's checks of a new attribute take longer
        self.parts[:] = self.shard.step(self._decode(actions))
        return self._output(stepped=True)

    def _observed(self) -> TensorDictBase:
        return self._output(stepped=False).select(*self.observation_spec.keys(True, True))

    def get_extra_state(self) -> dict[str, Any]:  # type: ignore[override]
        """Return the state of the generator and of the running episodes."""
        state: dict[str, Any] = {"generator": self.generator.get_state(), "seeds": list(self.seeds)}
        if self.seeds:
            state["ages"] = self.ages.tolist()
            shape = (len(self.actions), *self.action_spec.shape)
            state["actions"] = torch.from_numpy(np.reshape(list(self.actions), shape))
            state["observed"] = self._observed().to_dict()
        return state

    def set_extra_state(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        """Restore the generator, and the running episodes by repeating their actions."""
        self.generator.set_state(state["generator"].cpu())
        self.seeds, self.continues = list(state["seeds"]), True
        self.actions.clear()
        if not self.seeds:
            return
        self.ages[:] = state["ages"]
        actions = state["actions"].cpu().numpy()
        self.actions.extend(actions)
        steps, longest = self._decode(actions), len(actions)
        self.continues = longest >= self.ages.max()
        taken = {}
        if self.continues:
            taken = {row: steps[longest - age :, row] for row, age in enumerate(self.ages)}
        self.begin(dict(enumerate(self.seeds)), taken)
        self.continues = self.continues and same(self._observed().to_dict(), state["observed"])
        if not self.continues:
            warnings.warn(
                "the env cannot go on with its running episodes to the bit, so new ones begin"
                f"{self.remedy}",
                stacklevel=2,
            )


def same(one: Any, other: Any) -> bool:
    """Return whether two nested dictionaries of tensors are equal, NaN included."""
    if isinstance(one, dict):
        if one.keys() != other.keys():
            return False
        return all(same(value, other[key]) for key, value in one.items())
    return np.array_equal(one.cpu().numpy(), other.cpu().numpy(), equal_nan=one.is_floating_point())


def optional_entries(env: EnvBase) -> Sequence[tuple[str, ...]]:
    """Return the entries in which NaN is a number without a value; none in an env of another kind.

    Args:
        env: an env, with or without transforms. A `SerialEnv` cannot be asked for an attribute.
    """
    base = env.base_env if isinstance(env, TransformedEnv) else env
    return base.optional if isinstance(base, SeededRows) else ()
