"""A TorchRL env that never ends and names no limit is truncated after 1,000 steps."""

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from plants import Plant
from tensordict.nn import TensorDictModule
from torchrl.envs import GymWrapper, StepCounter, TransformedEnv
from worlds import Script

from coil_rl import EnvBatch, GymnasiumEnv
from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.foreign.limit import limit_of, limits_of
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.run.parts import EnvMaker

LIMIT = 30  # in place of 1,000, which takes long


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr("coil_rl.foreign.limit.LIMIT", LIMIT)


class Endless(Script):
    """It is never done; its reward is 1 in each step."""

    def __init__(self, *batch):
        ones = torch.ones(1, *batch, 1)
        super().__init__(torch.full(batch, 10**9), ones, observation=0 * ones)


def stay(env):
    return TensorDictModule(torch.zeros_like, in_keys=["observation"], out_keys=["action"])


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("make", [lambda: Endless(2), lambda: EnvBatch(Endless, num_envs=2)])
def test_endless_env_is_truncated_and_says_so_once(make):
    env = EnvMaker(lambda rows, cases, count: make())(2)
    assert "limit_count" not in make().observation_spec
    with pytest.warns(UserWarning, match="did not end within 30 steps") as said:
        result = evaluate_policy(env, stay(env))
    assert [(row["steps"], row["reward"]) for row in result.episodes] == [(30, 30.0)] * 2
    assert "Endless" in str(said[0].message)
    after = env.rollout(30, stay(env), break_when_any_done=False)["next"][:, -1]
    assert after["done"].all()
    assert not after["terminated"].any()


@pytest.mark.usefixtures("few")
def test_rows_count_their_own_steps():
    env = TransformedEnv(Endless(2), *limits_of(Endless(2)))
    carrier = env.reset()
    for step in range(1, 31):
        after, carrier = env.step_and_maybe_reset(env.rand_action(carrier))
        if step == 10:
            mask = torch.tensor([[True], [False]])
            carrier = env.reset(carrier.set("_reset", mask))
    assert after["next", "done"].view(-1).tolist() == [False, True]


@pytest.mark.parametrize(
    "make",
    [
        lambda: TransformedEnv(Endless(2), StepCounter(5)),
        lambda: GymWrapper(gymnasium.make("Pendulum-v1")),
        lambda: TransformedEnv(GymWrapper(gymnasium.make("Pendulum-v1"))),
    ],
)
def test_limit_that_an_env_names_is_left_to_it(make):
    env = make()
    assert limit_of(env) is None
    assert not limits_of(env)


def test_envs_of_the_project_are_left_as_they_are():
    env = ConeTrackEnv(shipped_tracks("train")[:1], num_envs=1)
    assert not limits_of(env)


def test_attribute_only_makes_the_limit_longer():
    class Planner(Endless):
        horizon = 10

    class Patient(Endless):
        max_steps = 1010

    assert [part.max_steps for part in limits_of(Patient(2))] == [1010]
    assert [part.max_steps for part in limits_of(Planner(2))] == [1000]


@pytest.mark.usefixtures("few")
def test_rows_of_a_batch_keep_a_longer_limit():
    env = EnvBatch(lambda: TransformedEnv(Endless(), StepCounter(40)), num_envs=1)
    steps = evaluate_policy(env, stay(env)).episodes[0]["steps"]
    assert steps == 40


def ended(env, steps):
    """Return after how many steps the first row ends; None if it does not."""
    carrier = env.reset()
    for step in range(1, steps + 1):
        carrier = env.step(env.rand_action(carrier))["next"]
        if carrier["done"].any():
            return step, bool(carrier["truncated"].any())
    return None


class Named(Plant):
    max_steps = 40


class Mistaken(Plant):
    horizon = 10  # of a predictive controller


class AlsoMistaken(Plant):
    horizon = np.int64(40)


def limited(**_):
    """Return the plant with a limit of 6 steps inside of another wrapper."""
    return gymnasium.wrappers.OrderEnforcing(gymnasium.wrappers.TimeLimit(Plant(), 6))


gymnasium.register("LimitedInside-v0", limited)


@pytest.mark.usefixtures("few")
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("id", "max_steps", "expected"),
    [
        (Plant, 4, 4),
        (partial(Plant, end=6), None, 6),
        (partial(Named, end=40), None, 40),
        *((limited, None, 6), (limited, 3, 3), (limited, 9, 9), ("LimitedInside-v0", 9, 9)),
    ],
)
def test_limit_of_an_env_is_its_own_or_that_of_the_user(id, max_steps, expected):
    assert ended(GymnasiumEnv(id, max_steps=max_steps), 50) == (expected, True)


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize(("id", "expected"), [(Plant, 30), (Mistaken, 30), (AlsoMistaken, 40)])
def test_env_without_a_limit_gets_one_that_is_said_and_attributes_make_it_longer(id, expected):
    with pytest.warns(UserWarning, match=rf"not end within {expected} steps, and no TimeLimit"):
        assert ended(GymnasiumEnv(id, 2), 50) == (expected, True)
