"""Each contract check finds its defect in a part that is broken on purpose."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
import worlds
from gymnasium import spaces
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Unbounded
from torchrl.envs import (
    GymEnv,
    PendulumEnv,
    SerialEnv,
    StepCounter,
    TensorDictPrimer,
    Transform,
    TransformedEnv,
)

from coil_rl import GymnasiumEnv, NormalisedAction
from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import PerRow, RandomGuide, SplineGuide
from coil_rl.testing import check_env, check_guide, check_transform


def cones(cars=3):
    return ConeTrackEnv(shipped_tracks("test"), cars, rate=6)


class Guide(TensorDictModuleBase):
    """Adds up the steering of an episode; its variants are broken."""

    in_keys, out_keys = ["steering", "total", "is_init"], ["action", ("next", "total")]

    def forward(self, tensordict):
        total = tensordict["total"] + tensordict["steering"] / 100
        return tensordict.set("action", self.action(total)).set(("next", "total"), total)

    def action(self, total):
        return total

    def make_tensordict_primer(self):
        return TensorDictPrimer({"total": Unbounded((1,))}, expand_specs=True)


class OneNumber:
    """A controller of one row."""

    total = 0.0

    def reset(self):
        self.total = 0.0

    def act(self, steering):
        self.total += float(steering[0]) / 100
        return self.total


def with_action(change):
    guide = Guide()
    guide.action = change
    return guide


class RowsInside(TensorDictModuleBase):
    """Remembers a number for each row in an attribute."""

    in_keys, out_keys, total = ["steering"], ["action"], 0.0

    def forward(self, tensordict):
        self.total = self.total + tensordict["steering"] / 1000
        return tensordict.set("action", self.total.clone())


class ForgetsAlone(TensorDictModuleBase):
    """Forgets at the start of an episode of all rows, not of some."""

    in_keys, out_keys = ["steering", "is_init"], ["action"]
    total = None

    def forward(self, tensordict):
        steering = tensordict["steering"] / 100
        if tensordict["is_init"].all() and len(steering) == 3:
            self.total = torch.zeros_like(steering)
        rows = slice(0, len(steering))
        self.total[rows] += steering
        return tensordict.set("action", self.total[rows].clone())


class OfAllRows(TensorDictModuleBase):
    """Steers for the mean of all rows."""

    in_keys, out_keys = ["steering"], ["action"]

    def forward(self, tensordict):
        steering = tensordict["steering"]
        return tensordict.set("action", steering.mean(0).expand_as(steering))


class FailsAlone(RowsInside):
    """Forgets at the start of an episode of all rows, and cannot take some of them."""

    in_keys, out_keys = ["steering", "is_init"], ["action"]

    def forward(self, tensordict):
        if tensordict["is_init"].all() and len(tensordict) == 3:
            self.total = 0.0
        return super().forward(tensordict)


@pytest.mark.slow
def test_guides_with_a_memory_pass():
    check_guide(Guide(), cones())
    check_guide(PerRow(OneNumber, ["steering"]), cones())
    check_guide(SplineGuide(), cones())
    lean = worlds.acting(lambda x: (x[..., 2] > 0).long(), "observation")
    check_guide(lean, worlds.carts().base_env)
    turn = worlds.acting(lambda x: -x.unsqueeze(-1).clamp(-2, 2), "thdot")
    check_guide(turn, PendulumEnv())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: with_action(lambda total: total.squeeze(-1)),
            r"has the shape \[3\], but must have \[3, 1\]",
        ),
        (
            lambda: with_action(lambda total: (total * 0).long()),
            "is of torch.int64, but the env's of torch.float32",
        ),
        (
            lambda: with_action(lambda total: total + 1.5),
            "lies outside the bounds of the env's action",
        ),
        (
            lambda: with_action(lambda total: total / total.abs().clamp(max=0)),
            "holds a number that is not finite",
        ),
        (OfAllRows, "depends on what was before it, or on the other rows"),
        (RandomGuide, "gives other actions for the same observations from the same start"),
        (RowsInside, "or keeps something that no reset reaches"),
        (FailsAlone, "fails after a single row was reset, so it may remember in itself"),
        (ForgetsAlone, "after the reset of a row depends on what was before it"),
    ],
)
def test_defect_of_a_guide_is_found(make, message):
    with pytest.raises(ValueError, match=message):
        check_guide(make(), cones())


def test_reset_that_touches_other_rows_is_found():
    everyone = []

    class Shared(OneNumber):
        def __init__(self):
            everyone.append(self)

        def reset(self):
            for other in everyone:
                other.total = 0.0

    with pytest.raises(ValueError, match="the guide gives a row other actions beside other rows"):
        check_guide(PerRow(Shared, ["steering"]), cones())


class Unseeded(PendulumEnv):
    rng_of_numpy = np.random.default_rng()

    def _reset(self, tensordict, **options):
        data = super()._reset(tensordict, **options)
        return data.set("th", data["th"] * float(self.rng_of_numpy.random()))


class NotANumber(PendulumEnv):
    @staticmethod
    def _step(tensordict):
        data = PendulumEnv._step(tensordict)
        return data.set("reward", data["reward"] * torch.nan)


class InPlace(PendulumEnv):
    @staticmethod
    def _step(tensordict):
        data = PendulumEnv._step(tensordict)
        tensordict["th"].copy_(data["th"])
        return data


class ResetsAll(ConeTrackEnv):
    def _reset(self, tensordict=None, **options):
        return super()._reset(None, **options)


class Tank(gymnasium.Env):
    """A level that may be beyond the bounds of its space.

    Args:
        level: its largest value, m.
    """

    action_space = spaces.Box(0.0, 1.0, (1,))
    observation_space = spaces.Dict(
        {"level": spaces.Box(0.0, 0.1, (2,), np.float64), "free": spaces.Box(-np.inf, np.inf)}
    )

    def __init__(self, level=0.1):
        self.level = level

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return {"level": np.zeros(2), "free": np.array([1e9], np.float32)}, {}

    def step(self, action):
        self.steps += 1
        observation = {"level": np.array([0.0, self.level]), "free": np.array([-1e9], np.float32)}
        return observation, 0.0, False, self.steps >= 20, {}


def test_observation_outside_of_its_space_is_said():
    said = (
        r"number 1 of the observation\.level is 1e\+09, but the observation_space of Tank has it "
        r"from 0 to 0\.1; correct its bounds"
    )
    with pytest.warns(UserWarning, match=said) as caught:
        check_env(GymnasiumEnv(Tank, 2, options={"level": 1e9}), steps=4)
    assert len(caught) == 1
    with pytest.warns(UserWarning, match=said):
        check_env(
            TransformedEnv(GymnasiumEnv(Tank, options={"level": 1e9}), NormalisedAction()), steps=4
        )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(GymnasiumEnv(Tank, 2), steps=4)


def test_entry_without_numbers_is_within_its_space():
    class Partial(Tank):
        observation_space = spaces.Dict({**Tank.observation_space, "spare": spaces.Box(0, 1, (0,))})

        def reset(self, **options):
            observation, info = super().reset(**options)
            return observation | {"spare": np.zeros(0)}, info

        def step(self, action):
            observation, *others = super().step(action)
            return observation | {"spare": np.zeros(0)}, *others

    check_env(GymnasiumEnv(Partial, 2), steps=4)


def test_check_of_a_guide_says_how_to_make_more_rows():
    lean = PerRow(lambda: OneNumber(), ["level"])
    with pytest.raises(ValueError, match=r"not \[1\]; make it with more, .*num_envs=2\)"):
        check_guide(lean, GymnasiumEnv(Tank))


class Noise(Transform):
    """Noise whose generator is not part of the state."""

    def __init__(self):
        super().__init__(in_keys=["steering"], out_keys=["steering"])
        self.generator = torch.Generator().manual_seed(0)

    def _call(self, next_tensordict):
        noise = torch.rand(next_tensordict["steering"].shape, generator=self.generator)
        return next_tensordict.set("steering", next_tensordict["steering"] * noise)

    def _reset(self, tensordict, tensordict_reset):
        return self._call(tensordict_reset)


class Overwrites(Transform):
    def _step(self, tensordict, next_tensordict):
        tensordict["steering"].fill_(0.5)
        return next_tensordict


class Undeclared(Transform):
    def _call(self, next_tensordict):
        return next_tensordict.set("more", next_tensordict["steering"])


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (Unseeded, "the same seed gives other values of th"),
        (NotANumber, r"\('next', 'reward'\) holds a number that is not finite|reward"),
        (InPlace, "a step changed th of the data before it; write new tensors"),
        (lambda: ResetsAll(shipped_tracks("test"), 3), "resetting row 0 changed .* of other rows"),
        (Noise, "the same seed gives other values of steering"),
        (Overwrites, "a step changed steering of the data before it"),
        (Undeclared, "more"),
    ],
)
def test_defect_of_an_env_or_a_transform_is_found(part, message):
    made = part()
    with pytest.raises((ValueError, AssertionError), match=message):
        check_transform(cones(), made) if isinstance(made, Transform) else check_env(made, steps=4)


class RemembersInAnAttribute(Transform):
    """Writes the observation of the step before, from a plain attribute."""

    def __init__(self):
        super().__init__(in_keys=["steering"], out_keys=["last"])
        self.last = None

    def _reset(self, tensordict, reset):
        self.last = reset["steering"].clone()
        return reset.set("last", self.last)

    def _step(self, tensordict, after):
        after.set("last", self.last)
        self.last = after["steering"].clone()
        return after

    def transform_observation_spec(self, spec):
        spec["last"] = spec["steering"].clone()
        return spec


class RemembersInTheData(RemembersInAnAttribute):
    def _step(self, tensordict, after):
        return after.set("last", tensordict["steering"])


@pytest.mark.slow
def test_memory_of_a_transform_survives_a_resume():
    check_transform(cones(), RemembersInTheData())
    with pytest.raises(ValueError, match=r"InAnAttribute gives another last in step 1 of a res"):
        check_transform(cones(), RemembersInAnAttribute())


def pendulum():
    return GymEnv("Pendulum-v1")


@pytest.mark.parametrize("make", [pendulum, lambda: SerialEnv(2, pendulum)])
def test_transform_is_not_blamed_for_an_env_that_cannot_be_restored(make):
    with pytest.warns(UserWarning, match="cannot go on from the middle of an episode"):
        check_transform(make(), StepCounter())
