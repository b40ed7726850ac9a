"""Delays: each row of each episode has its own lag, and nothing else changes."""

import numpy as np
import pytest
import torch
import worlds
from gymnasium import spaces
from plants import Plant
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, MultiCategorical, OneHot, Unbounded
from torchrl.envs import (
    Compose,
    EnvBase,
    ExcludeTransform,
    ObservationNorm,
    TransformedEnv,
)

from coil_rl import GymnasiumEnv
from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import SplineGuide
from coil_rl.testing import check_transform
from coil_rl.transforms import (
    ActionDelay,
    GuideActions,
    LastAction,
    ObservationDelay,
    ObservationNoise,
)

ACTIONS = {
    "numbers": Bounded(-1, 1, (3, 2)),
    "one choice": Categorical(4, (3,)),
    "one-hot choice": OneHot(4, (3, 4)),
    "two choices": MultiCategorical([2, 3], (3, 2)),
}


class Counter(EnvBase):
    """Three rows that show the number of their step, nested and as a vector, and the action.

    The episodes of the rows take 4, 5 and 6 steps.
    """

    def __init__(self, action=ACTIONS["numbers"]):
        super().__init__(batch_size=[3])
        self.action_spec = action.clone()
        self.observation_spec = Composite(
            observation=Unbounded((3, 2)),
            inner=Composite(count=Unbounded((3, 1), dtype=torch.int64), shape=(3,)),
            info=Composite(step=Unbounded((3, 1)), shape=(3,)),
            executed=Unbounded(action.shape, dtype=action.dtype),
            shape=(3,),
        )
        self.reward_spec = Unbounded((3, 1))
        self.count = torch.zeros(3, 1)

    def _shown(self, executed):
        shown = TensorDict({"observation": self.count.expand(3, 2).clone()}, [3])
        shown["inner", "count"] = self.count.long()
        shown["info", "step"] = self.count.clone()
        return shown.set("executed", executed)

    def _reset(self, tensordict=None, **_):
        mask = tensordict["_reset"] if tensordict is not None and "_reset" in tensordict else True
        self.count = torch.where(torch.as_tensor(mask), torch.zeros(3, 1), self.count)
        return self._shown(self.action_spec.zero())

    def _step(self, tensordict):
        self.count = self.count + 1
        done = self.count >= torch.tensor([[4], [5], [6]])
        shown = self._shown(tensordict["action"])
        return shown.update({"reward": torch.zeros(3, 1), "done": done, "terminated": done})

    def _set_seed(self, seed):
        pass


def driven(env, steps=24):
    """Return what a rollout with resets writes before and after each step, [3, steps]."""
    torch.manual_seed(0)
    return env.rollout(steps, break_when_any_done=False)


def test_observations_are_those_of_the_lag_of_their_row_and_episode():
    env = TransformedEnv(Counter(), ObservationDelay(1, 3, seed=5))
    seen = driven(env)["next"]
    lag, true = seen["late_observations", "lag"], seen["info", "step"]
    assert torch.equal(seen["observation"], (true - lag).clamp(min=0).expand(3, 24, 2))
    assert torch.equal(seen["inner", "count"], (true - lag).clamp(min=0).long())
    starts = true == 1
    assert set(lag[starts].tolist()) == {1, 2, 3}
    # A lag holds for its episode, whichever other rows begin another one meanwhile.
    assert torch.equal(lag[:, 1:][~starts[:, 1:]], lag[:, :-1][~starts[:, 1:]])


def test_without_names_the_entries_of_the_env_are_late_that_are_still_there_and_no_measures():
    before = [ExcludeTransform("executed"), LastAction()]
    env = TransformedEnv(Counter(), Compose(*before, ObservationDelay(2, 2)))
    assert set(env.transform[-1].late_keys) == {"observation", ("inner", "count")}
    data = env.rollout(4)
    assert data["observation"][0, :, 0].tolist() == [0, 0, 0, 1]
    assert data["info", "step"][0, :, 0].tolist() == [0, 1, 2, 3]


def test_only_the_entries_that_are_named_are_late():
    env = TransformedEnv(Counter(), ObservationDelay(2, 2, [["inner", "count"]]))
    seen = driven(env)["next"]
    assert torch.equal(seen["observation"][..., :1], seen["info", "step"])
    assert torch.equal(seen["inner", "count"], (seen["info", "step"] - 2).clamp(min=0).long())


@pytest.mark.parametrize("kind", ACTIONS)
def test_actions_take_effect_after_the_lag_and_the_first_one_until_then(kind):
    env = TransformedEnv(Counter(ACTIONS[kind]), ActionDelay(0, 3, seed=1))
    data = driven(env)
    lags = set()
    for row in range(3):
        for step in range(24):
            lag = int(data["late_actions", "lag"][row, step])
            lags.add(lag)
            of_episode = int(data["info", "step"][row, step])
            given = data["action"][row, step - min(lag, of_episode)]
            assert torch.equal(data["next", "executed"][row, step], given)
    assert lags == {0, 1, 2, 3}


@pytest.mark.parametrize("kind", ACTIONS)
def test_last_actions_are_those_that_the_agent_chose(kind):
    env = TransformedEnv(Counter(ACTIONS[kind]), Compose(ActionDelay(2, 2), LastAction(steps=2)))
    data = driven(env, 4)
    vectors = env.transform[1].action_space.vectors(data["action"])
    size = vectors.shape[-1]
    assert data["last_action"][:, 0].eq(0).all()
    assert torch.equal(data["next", "last_action"][..., :size], vectors)
    assert torch.equal(data["next", "last_action"][:, 1:, size:], vectors[:, :-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "make",
    [
        lambda seed: ObservationDelay(1, 3, seed=seed),
        lambda seed: ActionDelay(0, 2, seed=seed),
        lambda seed: ObservationNoise(0.2, seed=seed),
        lambda seed: LastAction(3),
        lambda seed: Compose(
            ObservationDelay(0, 2, seed=seed), ActionDelay(1, 2, seed=seed), ObservationNoise()
        ),
    ],
)
def test_contract_holds_and_a_restored_env_goes_on_to_the_bit(make):
    check_transform(Counter(), make(0))
    check_transform(worlds.cones(), make(1))
    check_transform(worlds.cones().base_env, make(2))


@pytest.mark.parametrize("delay", [ObservationDelay, ActionDelay])
def test_no_lag_changes_nothing(delay):
    plain, delayed = driven(Counter()), driven(TransformedEnv(Counter(), delay(0, 0)))
    memory = ("late_observations", "late_actions")
    assert (plain == delayed.exclude(*memory, *(("next", key) for key in memory))).all()


def test_a_guide_sees_what_comes_before_it_in_the_chain():
    def advice(*transforms):
        cars = ConeTrackEnv(shipped_tracks("test"), 3)
        env = TransformedEnv(cars, Compose(*transforms))
        return torch.stack([step["guide_action"] for step in worlds.drive(env, 6)[0]])

    def guide():
        return GuideActions({"spline": SplineGuide()})

    exact = advice(guide())
    late = advice(ObservationDelay(2, 2), guide())
    assert torch.equal(late[2:], exact[:-2])
    assert torch.equal(advice(guide(), ObservationDelay(2, 2)), exact)
    both = ObservationDelay(2, 2, ["observation", "guide_action"])
    assert torch.equal(advice(guide(), both), late)


def test_noise_has_its_standard_deviation_and_stays_within_the_bounds():
    def seen(*transforms):
        cars = ConeTrackEnv(shipped_tracks("test"), 64, assignment="cyclic")
        steps, _ = worlds.drive(TransformedEnv(cars, Compose(*transforms)), 8)
        return torch.stack([step["observation"] for step in steps])

    values = seen()
    noise = seen(ObservationNoise(0.1)) - values
    assert abs(float(noise[values.abs() < 0.5].std()) - 0.1) < 0.003
    assert float((values + noise).abs().max()) <= 1


class Ramp(Plant):
    """Numbers that rise by 0.1 a step, up to beyond their bounds."""

    def __init__(self):
        numbers = spaces.Box(np.float32([0, -np.inf, 0]), np.float32([1, 1, np.inf]))
        choices = {"choice": spaces.Discrete(3), "pair": spaces.MultiDiscrete([2, 3])}
        seen = spaces.Dict(x=numbers, flags=spaces.MultiBinary(2), **choices)
        super().__init__(seen, spaces.Discrete(2), end=20)

    def look(self):
        rest = {"choice": 0, "pair": np.zeros(2, int), "flags": np.zeros(2, np.int8)}
        return {"x": np.full(3, 0.1 * self.time, np.float32), **rest}


@pytest.mark.slow
@pytest.mark.parametrize("lag", [0, 1])
def test_noise_stays_within_the_bounds_of_a_gymnasium_env(lag):
    def seen(*transforms):
        env = GymnasiumEnv(Ramp, 64)
        env = TransformedEnv(env, Compose(ObservationDelay(lag, lag), *transforms))
        return env.rollout(18)["x"].unbind(-1)

    exact, noisy = seen(), seen(ObservationNoise(0.5, ["x"]))
    assert float(exact[0].max()) > 1, "the env leaves its own bounds"
    for values, found, low, high in zip(exact, noisy, (0, None, 0), (1, 1, None), strict=True):
        assert low is None or bool((found >= values.clamp(max=low)).all())
        assert high is None or bool((found <= values.clamp(min=high)).all())
        assert float((found - values).std()) > 0.25


def test_noise_takes_no_bounds_for_those_of_a_changed_entry():
    changed = Compose(ObservationNorm(0.0, 100.0, in_keys=["x"]), ObservationNoise(0.5, ["x"]))
    env = TransformedEnv(GymnasiumEnv(Ramp, 64), changed)
    assert float(env.reset()["x"].min()) < -1


@pytest.mark.parametrize("key", ["choice", "pair", "flags"])
def test_noise_on_choices_is_refused(key):
    env = TransformedEnv(GymnasiumEnv(Ramp), ObservationNoise(0.5, [key]))
    with pytest.raises(ValueError, match=f"has '{key}', but .* these real numbers: 'x'"):
        env.reset()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ObservationDelay(2, 1), "min_lag=2 must be at most max_lag=1"),
        (lambda: ActionDelay(-1, 1), "min_lag=-1 must be at least 0"),
        (lambda: ActionDelay(0, 10**6), "max_lag=1000000 must be at most 10000"),
        (lambda: ObservationDelay(0, 0.5), "max_lag=0.5 must be a valid integer"),
        (lambda: ObservationNoise(0.1, []), "in_keys is empty"),
        (
            lambda: TransformedEnv(Counter(), ObservationDelay(0, 1, ["scan"])).reset(),
            "has 'scan', but the env writes these numbers: 'observation'",
        ),
        (
            lambda: TransformedEnv(Counter(), Compose(ActionDelay(), ActionDelay())).reset(),
            "'late_actions', which exists already; give each delay a memory_key",
        ),
        (lambda: ActionDelay()(TensorDict()), "ActionDelay needs the previous steps"),
    ],
)
def test_wrong_arguments_are_refused_in_a_sentence(make, message):
    with pytest.raises((ValueError, TypeError, RuntimeError), match=message):
        make()
