"""Gymnasium envs as one batched TorchRL env, with controllers beside them.

TorchRL has a wrapper of its own. This one is seeded episode by episode, so that it can go on after
an interruption (see `SeededRows`), names what is missing in one sentence, and lets controllers act
beside the env that need the env itself, not only its observation.
"""

import math
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from coil_rl.foreign.batch import SeededRows
from coil_rl.foreign.codec import Codec
from coil_rl.foreign.faults import ForeignError, shortened
from coil_rl.foreign.guard import Guard
from coil_rl.foreign.makers import (
    Env,
    make_env,
    maker_of,
    metadata_of,
    name_of,
)
from coil_rl.foreign.plant import GymnasiumPlant
from coil_rl.foreign.remembered import Anew
from coil_rl.foreign.rows import GymnasiumRows
from coil_rl.foreign.workers import Workers, choose, timed
from coil_rl.ranges import Count, Processes, Seed, checked

NOT_OBSERVED = ("info", "controller")  # for evaluation, and of what acts beside the env
RESERVED = ("action", "reward", "done", "terminated", "truncated", "info", "controller", "next")


@checked
class GymnasiumEnv(SeededRows):
    """Gymnasium envs as one env of batch size [num_envs].

    They are stepped one after the other in this process, or in several ones at once (`workers`).

    Reads `action`. Writes `reward`, `done`, `terminated`, `truncated` [B, 1] and the observation:
    `observation`, or one entry a key of a Dict space (nested as there; a Tuple has the keys "0",
    "1", ...). A Box is a tensor of `dtype`, but pixels stay uint8; Discrete and MultiDiscrete are
    one-hot vectors of `dtype`, MultiBinary is one of 0 and 1; texts are left out. Actions are
    bounded or unbounded for a Box (and clamped to its bounds; a matrix is a vector), indices from 0
    for Discrete [B], MultiDiscrete [B, n] and a Box of a few whole numbers [B, n], and 0 or 1 for
    MultiBinary.

    A row whose episode is over stays as it is, with reward 0, until it is reset. A restored state
    goes on to the bit if the env is deterministic, see `SeededRows`. `rate` is the steps per second
    at which the env is drawn, NaN if it does not say.

    Args:
        id: registered name; "MODULE:NAME" imports the module first. Or a maker of an env: a class
            or function, or the "MODULE:NAME" of one.
        num_envs: B, number of rows.
        options: keyword arguments of `gymnasium.make`, or of the maker.
        reset_options: `options` of each `reset` of the env, such as where an episode begins.
        wrappers: callables that take an env and return one, applied in this order.
        max_steps: steps after which an episode is truncated, instead of the registered number or
            that of a `TimeLimit` of the maker. An env that names no number at all is truncated
            after 1,000, with a warning.
        cases: number of different episodes, by default `num_envs`; needs `first_seed`.
        info: names of numbers in Gymnasium's info to write as ("info", NAME) [B, 1], NaN where
            missing.
        controllers: by name: anything that a guide may be, see `ControllerGuide`, or `MODULE:NAME`.
            Each env has its own, and a class or function with a parameter `env` gets it, as
            `THING(env)` and `THING(env, observation)`. The action for the present observation is
            written as ("controller", NAME), not clamped, in the env's own numbering; after a
            termination it is the last one.
        fresh: whether every episode has a new env, for those whose reset leaves something of the
            past. BipedalWalker is one: without `fresh`, its episodes depend on the seed and, a
            little, on those before.
        render: whether `render` gives pictures, of the rows that begin with the first of `cases`
            different episodes.
        workers: number of processes over which the rows are spread, 0 for none besides this one;
            "auto" for as many as there are cores if a timed step is long enough. The digits are
            the same.
        dtype: of all floating-point tensors.

    Attributes:
        observation_bounds: declared bounds of the entries that have any, which they may leave.
        own_forms: what converts entries from the form of networks to that of the env, by entry.
        optional: entries in which NaN is a number without a value, not a fault: those of `info`.
        seconds: of a step of one row, by kind of env; the envs of a run share them.

    Raises:
        ValueError: if the env cannot be made, has a space that is not supported or an entry with a
            reserved name or bounds that leave no choice, or if a controller cannot act.
        ForeignError: at a reset or a step, for what the env or a controller raises or returns that
            does not fit; see `coil_rl.foreign.faults`.

    Example:
        >>> from coil_rl import GymnasiumEnv
        >>> env = GymnasiumEnv("CartPole-v1", num_envs=4)
        >>> env.rollout(3, break_when_any_done=False)["next", "observation"].shape
        torch.Size([4, 3, 4])
    """

    remedy = "; fresh=true helps where a reset leaves something of the past"

    def __init__(
        self,
        id: str | Callable[..., Env],
        num_envs: Count = 1,
        *,
        options: Mapping[str, Any] | None = None,
        reset_options: Mapping[str, Any] | None = None,
        wrappers: Sequence[Callable[[Env], Env]] = (),
        max_steps: Count | None = None,
        seed: Seed = 0,
        first_seed: Seed | None = None,
        cases: Count | None = None,
        info: Sequence[str] = (),
        controllers: Mapping[str, Any] | None = None,
        fresh: bool = False,
        render: bool = False,
        workers: Processes = 0,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        makers = dict(controllers or {})
        settings = dict(options or {})
        if max_steps is not None:
            settings["max_episode_steps"] = max_steps
        guard = Guard()
        with guard:
            maker = maker_of(id)
            make = Anew(make_env, maker, wrappers, settings)
            self.shown = render and "rgb_array" in metadata_of(make(), "render_modes", ())
        drawn, every = make, cases or num_envs
        if self.shown:
            # Without a screen pygame prints an error in the middle of a run.
            if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
                os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
            drawn = Anew(make_env, maker, wrappers, settings | {"render_mode": "rgb_array"})
        name = name_of(maker)

        def make_plant(row: int) -> GymnasiumPlant:
            made = make if row % every else drawn
            return GymnasiumPlant(made, makers, reset_options, fresh, name, row)

        self.make_plant, self.asked = make_plant, workers
        self.kind = f"{name} {settings} {wrappers} {makers}"
        self.seconds: dict[str, float | None] = {}
        self.workers: Workers | None = None
        self.info, self.optional = tuple(info), [("info", name) for name in info]
        with guard:
            first = make_plant(0)
        self.codec = Codec(name, first.env, dtype)
        # With processes, row 0 of this one only says what the spaces are.
        self.held = GymnasiumRows(self.codec, self.info, guard).extend([first])
        if not workers:
            self.held.extend(map(make_plant, range(1, num_envs)))
        super().__init__(self.held, num_envs, seed, first_seed, cases, device)
        rate = metadata_of(first.env, "render_fps", math.nan)
        self.rate = float(rate) if isinstance(rate, (int, float)) else math.nan
        actions = self.codec.actions
        self.first_choices, self.own_shape = actions.first, actions.own_shape
        self._declare_specs(name, makers, dtype)

    def _declare_specs(self, id: str, controllers: Iterable[str], dtype: torch.dtype) -> None:
        action, number = self.codec.actions.spec, Unbounded(1, dtype=dtype)
        observation = Composite()
        self.observation_bounds: dict[Any, tuple[torch.Tensor, torch.Tensor]] = {}
        self.own_forms = self.codec.own_forms
        for entry in self.codec.entries:
            if entry.name in RESERVED:
                raise ValueError(
                    f"the observation of {id} has an entry {entry.name!r}: rename it with a wrapper"
                )
            observation[entry.key] = entry.spec
            if entry.bounds is not None and entry.spec.dtype.is_floating_point:
                low, high = (torch.from_numpy(bound).to(self.device) for bound in entry.bounds)
                self.observation_bounds[entry.key] = low, high
        for name in self.info:
            observation["info", name] = number.clone()
        for name in controllers:
            # Advice is written as given, and may be out of bounds.
            advice = action.clone()
            if isinstance(action, Bounded) or self.first_choices is not None:
                advice = Unbounded(action.shape, dtype=action.dtype)
            observation["controller", name] = advice
        flag = Binary(1, dtype=torch.bool)
        ends = Composite({name: flag.clone() for name in ("done", "terminated", "truncated")})
        self.observation_spec = self._of_all_rows(observation)
        self.done_spec = self._of_all_rows(ends)
        self.action_spec = self._of_all_rows(action)
        self.reward_spec = self._of_all_rows(number)
        written = self.full_observation_spec, self.full_done_spec, self.full_reward_spec
        self.written = [entry for spec in written for entry in spec.items(True, True)]

    def _of_all_rows(self, spec: TensorSpec) -> TensorSpec:
        """Return the spec of a batch from that of one row."""
        return spec.to(self.device).expand(*self.batch_size, *spec.shape)

    @property
    def meanings(self) -> Any:
        """What the env says about its entries, see `coil_rl.envs.meanings`."""
        return getattr(self.held.plants[0].env.unwrapped, "meanings", None)

    def render(self, row: int = 0) -> NDArray[np.uint8] | None:
        """Return a picture, [height, width, 3]; None if there are none.

        Args:
            row: one that begins with the first of the different episodes.
        """
        if not self.shown:
            return None
        try:
            return self.held.picture(row) if self.workers is None else self.workers.picture(row)
        except ForeignError as error:
            self.shown = False
            cause = error if error.__cause__ is None else error.__cause__
            warnings.warn(f"no pictures of the env: {shortened(str(cause))}", stacklevel=2)
            return None

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close all envs."""
        self.held.close()
        if self.workers is not None:
            self.workers.close()
        super().close(raise_if_closed=raise_if_closed)

    def begin(
        self, seeds: Mapping[int, int], actions: Mapping[int, Sequence[Any]] | None = None
    ) -> None:
        """Begin episodes, see `Rows`; the rows are made before the first one."""
        if not self.parts:
            self._place_rows()
        super().begin(seeds, actions)

    def stay_in_process(self) -> None:
        """Use no processes from here on; running episodes are lost."""
        self.asked = 0
        if self.workers is not None:
            self.workers.close()
            self.shard, self.workers = self.held, None
            self.parts.clear()

    def _place_rows(self) -> None:
        """Decide in which processes the rows are, and make them there."""
        count = self.batch_size[0]
        if count == len(self.held.plants):
            return
        codec, make_plant = self.codec, self.make_plant

        def make(rows: range) -> GymnasiumRows:
            return GymnasiumRows(codec, self.info, self.held.guard).extend(map(make_plant, rows))

        seconds = partial(timed, make, codec.actions.space.sample)
        number = choose(self.asked, count, seconds, codec.name, self.seconds, self.kind)
        if number:
            self.shard = self.workers = Workers(make, count, number, codec.name)
        else:
            self.held.extend(map(make_plant, range(1, count)))

    def encode(self, observation: Any, *, first: bool) -> TensorDict:
        """Return the entries of an env of one row for an observation that comes from elsewhere.

        Controllers beside the env are asked too; the env itself is not stepped.

        Args:
            observation: as a Gymnasium env of this kind gives it.
            first: whether it is the first one of an episode.
        """
        (plant,) = self.held.plants
        with self.held.guard:
            plant.observe(observation, first=first)
        self.parts[:] = [self.held.entries()]
        return self._output(stepped=not first)

    def decode(self, actions: torch.Tensor) -> Any:
        """Return the action of an env of one row as a Gymnasium env of this kind takes it."""
        (action,) = self._decode(actions.cpu().numpy())
        return action

    def _decode(self, actions: NDArray[Any]) -> NDArray[Any]:
        return self.codec.actions.decode(actions)

    def _output(self, *, stepped: bool) -> TensorDict:
        tensors: dict[Any, torch.Tensor] = {}
        for key, spec in self.written:
            if stepped or key != "reward":
                parts = [part[key] for part in self.parts]
                value = torch.from_numpy(np.concatenate(parts) if len(parts) > 1 else parts[0])
                tensors[key] = value.to(spec.dtype).reshape(spec.shape)
        data = TensorDict(tensors, self.batch_size)
        return data if self.device is None or self.device.type == "cpu" else data.to(self.device)
