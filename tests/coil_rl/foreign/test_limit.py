"""A TorchRL env that never ends and names no limit is truncated after 1,000 steps."""

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, GymWrapper, StepCounter, TransformedEnv

from coil_rl import EnvBatch, GymnasiumEnv
from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.foreign.limit import limit_of, limits_of
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.run.parts import EnvMaker

LIMIT = 30  # in place of 1,000, which takes long


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr("coil_rl.foreign.limit.LIMIT", LIMIT)


class Endless(EnvBase):
    """It is never done; its reward is 1 in each step."""

    def __init__(self, *batch):
        super().__init__(batch_size=batch)
        self.observation_spec = Composite(observation=Unbounded((*batch, 1)), shape=self.batch_size)
        self.action_spec = Bounded(-1, 1, (*batch, 1))
        self.reward_spec = Unbounded((*batch, 1))

    def _set_seed(self, seed):
        pass

    def _reset(self, tensordict=None):
        return TensorDict({"observation": torch.zeros(*self.batch_size, 1)}, self.batch_size)

    def _step(self, tensordict):
        after = {
            "observation": torch.zeros(*self.batch_size, 1),
            "reward": torch.ones(*self.batch_size, 1),
            "done": torch.zeros(*self.batch_size, 1, dtype=torch.bool),
        }
        return TensorDict(after, self.batch_size)


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


def test_attribute_only_makes_the_limit_longer():
    class Planner(Endless):
        horizon = 10

    class Named(Endless):
        max_steps = 1010

    assert [part.max_steps for part in limits_of(Named(2))] == [1010]
    assert [part.max_steps for part in limits_of(Planner(2))] == [1000]


def test_envs_of_the_project_are_left_as_they_are():
    env = ConeTrackEnv(shipped_tracks("train")[:1], num_envs=1)
    assert not limits_of(env)


@pytest.mark.usefixtures("few")
def test_rows_of_a_batch_keep_a_longer_limit():
    env = EnvBatch(lambda: TransformedEnv(Endless(), StepCounter(40)), num_envs=1)
    steps = evaluate_policy(env, stay(env)).episodes[0]["steps"]
    assert steps == 40


class Plant(gymnasium.Env):
    """It ends after some steps.

    Args:
        end: number of steps; None: never.
    """

    observation_space = action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def __init__(self, end=None):
        self.end = end

    def reset(self, *, seed=None, options=None):
        self.time = 0
        return [0.0], {}

    def step(self, action):
        self.time += 1
        return [0.0], 1.0, False, self.time == self.end, {}


def ended(env, steps):
    """Return after how many steps the first row ends; None if it does not."""
    carrier = env.reset()
    for step in range(1, steps + 1):
        carrier = env.step(env.rand_action(carrier))["next"]
        if carrier["done"].any():
            return step, bool(carrier["truncated"].any())
    return None


@pytest.mark.usefixtures("few")
def test_env_without_a_limit_gets_one_that_is_said():
    env = GymnasiumEnv(lambda: Plant(end=None), 2)
    with pytest.warns(UserWarning, match=r"did not end within 30 steps, and no TimeLimit"):
        assert ended(env, LIMIT + 5) == (LIMIT, True)


@pytest.mark.usefixtures("few")
@pytest.mark.filterwarnings("error")
def test_limit_of_an_env_is_its_own():
    assert ended(GymnasiumEnv(lambda: Plant(end=None), max_steps=4), 9) == (4, True)
    assert ended(GymnasiumEnv(lambda: Plant(end=6)), 9) == (6, True)

    class Named(Plant):
        max_steps = 40

    assert ended(GymnasiumEnv(lambda: Named(end=40)), 50) == (40, True)


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize(("steps", "expected"), [(10, LIMIT), (np.int64(40), 40)])
def test_attribute_of_a_gymnasium_env_only_makes_the_limit_longer(steps, expected):
    class Mistaken(Plant):
        horizon = steps  # of a predictive controller

    env = GymnasiumEnv(lambda: Mistaken(end=None))
    with pytest.warns(UserWarning, match=rf"did not end within {expected} steps"):
        assert ended(env, 50) == (expected, True)
