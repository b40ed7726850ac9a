"""Observations in physical units: decided on the first batch, said, and kept with the policy."""

import copy
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from tensordict import TensorDict

import coil_rl
from coil_rl.errors import UserError
from coil_rl.learners.normaliser import Moments
from coil_rl.run.training import training_of

TINY = ["budget.num_envs=4", "budget.steps=16", "evaluation.cases=2", "logger=none"]
TINY += ["evaluation.curve.num_envs=2", "evaluation.curve.points=1", "evaluation.gif=false"]
TINY += ["checkpoint_every=1"]
ON_POLICY = ["learner.minibatches=2"]
REPLAY = [
    "learner=sac",
    "learner.starts=16",
    "learner.updates_per_step=0.015625",
    "learner.batch_size=16",
]


class Reactor(gymnasium.Env):
    """A temperature and a height: in kelvin and metres, or in units of their own."""

    action_space = Box(-1, 1, (1,), np.float32)
    observation_space = Box(-np.inf, np.inf, (2,), np.float32)

    def __init__(self, offset=(0.0, 0.0), unit=(1.0, 1.0), render_mode=None):
        self.offset, self.unit = np.array(offset), np.array(unit)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.steps = self.np_random.normal(size=2), 0
        return self.seen(), {}

    def seen(self):
        return (self.offset + self.unit * self.state).astype(np.float32)

    def step(self, action):
        self.state = 0.9 * self.state + 0.3 * self.np_random.normal(size=2)
        self.steps += 1
        reward = -float(np.square(action - 0.5 * self.state[:1]).sum())
        return self.seen(), reward, False, self.steps >= 10, {}


PHYSICAL = partial(Reactor, (322.0, 7000.0), (0.5, 900.0))


def learned(env, folder, *overrides, frames=128, method="ppo"):
    run = coil_rl.prepare(
        env, method=method, frames=frames, folder=folder, overrides=[*TINY, *overrides]
    )
    run.begin()
    run.learn()
    return run


def used(run, which="last"):
    (moments,) = [m for m in run.policy(which=which).modules() if isinstance(m, Moments)]
    return bool(moments.used)


@pytest.mark.slow
def test_observations_in_scale_stay_as_they_are(tmp_path, capsys):
    run = learned(Reactor, tmp_path / "auto", *ON_POLICY)
    assert "normalise: observation is in scale and stays as it is" in capsys.readouterr().err
    assert not used(run)
    raw = learned(Reactor, tmp_path / "raw", *ON_POLICY, "learner.normalise=false")
    state, expected = run.policy().state_dict(), raw.policy().state_dict()
    for key, value in expected.items():
        found = [state[name] for name in state if name.endswith(key.split(".", 2)[2])]
        assert any(torch.equal(value, each) for each in found)


@pytest.mark.slow
def test_decision_is_resumed_to_the_bit(tmp_path, capsys):
    words = [*TINY, *ON_POLICY]
    run = coil_rl.prepare(
        PHYSICAL, method="ppo", frames=256, folder=tmp_path / "run", overrides=words
    )
    run.begin()
    experiment, other = training_of(run, 0), training_of(run, 0)
    experiment.update(0.0)
    other.load_state_dict(copy.deepcopy(experiment.state_dict()))
    capsys.readouterr()
    for each in (experiment, other):
        each.update(0.25)
    assert "normalise" not in capsys.readouterr().err  # decided once
    ours, theirs = (each.learner.normaliser.state_dict() for each in (other, experiment))
    assert all(torch.equal(value, theirs[name]) for name, value in ours.items())
    assert bool(other.learner.normaliser.moments[0].used)


@pytest.mark.slow
def test_raw_observations_far_out_of_scale_are_named(tmp_path):
    with pytest.warns(
        UserWarning,
        match=r"observation is observed as it is, but is far out of scale for a network: \[0\] "
        r"mean 32\d.* deviation .*, \[1\] mean .*; use learner.normalise=auto or true",
    ):
        learned(PHYSICAL, tmp_path / "run", *ON_POLICY, "learner.normalise=false")


def test_an_entry_is_never_in_scale_and_far_out_of_scale_in_one_batch():
    moments = Moments(torch.Size([1]), enough=1)
    moments.add(9.0 + 8.0 * torch.tensor([[-1.0], [1.0]]))  # its size is above 10
    assert moments.out_of_scale.item()


def test_steps_before_learning_decide_together_with_replay(capsys):
    env = coil_rl.GymnasiumEnv("Pendulum-v1", num_envs=2)
    sac = coil_rl.SAC(env, normalise="auto", starts=96)
    (moments,) = sac.normaliser.moments

    def learn(mean, deviation):
        batch = mean + deviation * torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]).repeat(16, 1)
        sac.normaliser.learn(TensorDict({"observation": batch}, 32))
        return bool(moments.used)

    assert learn(1.4, 0.02)  # where all episodes begin
    assert not learn(-1.4, 0.5)
    assert not capsys.readouterr().err
    assert not learn(0.0, 1.0)
    assert "normalise: observation is in scale and stays as it is" in capsys.readouterr().err
    assert not learn(500.0, 1.0)  # decided
    assert not capsys.readouterr().err


class Drifting(Reactor):
    """A reactor whose readings grow tenfold from episode to episode."""

    begun = 0

    def reset(self, *, seed=None, options=None):
        self.begun += 1
        return super().reset(seed=seed)

    def seen(self):
        return (10.0 ** min(self.begun - 1, 4) * self.state).astype(np.float32)


@pytest.mark.slow
def test_observations_that_leave_their_scale_later_are_named_once(tmp_path):
    with pytest.warns(UserWarning, match="out of scale") as found:
        learned(Drifting, tmp_path / "run", *ON_POLICY, "budget.steps=8", frames=512)
    texts = [str(each.message) for each in found]
    named = [text for text in texts if "far out of scale for a network: [0] mean" in text]
    assert len(named) == 1
    assert named[0].endswith("; use learner.normalise=true")


@pytest.mark.slow
def test_cone_world_and_robot_are_not_normalised():
    from coil_rl import compose_train

    for env in ("cone_track", "driving_tasks", "simulated_robot"):
        assert compose_train([f"env={env}"]).learner.normalise is False
    for env in ("lunar_lander", "cart_pole", "babyai"):
        assert compose_train([f"env={env}", "method=ppo"]).learner.normalise == "auto"


@pytest.mark.parametrize(
    ("mean", "variance", "wrong"),
    [
        (0.0, 1.0, False),
        (0.0, 0.0, False),
        (2.0, 0.0, False),
        (4.0, 0.0, True),
        (322.0, 0.25, True),
        (0.0, 1e-4, True),
        (0.0, 1e6, True),
        (2.0, 1.0, False),
    ],
)
def test_what_is_out_of_scale(mean, variance, wrong):
    moments = Moments(torch.Size([1]))
    moments.mean.fill_(mean)
    moments.variance.fill_(variance)
    assert moments.out_of_scale.tolist() == [wrong]


def test_other_word_is_refused(tmp_path):
    with pytest.raises(UserError, match="normalise"):
        learned(Reactor, tmp_path / "run", *ON_POLICY, "learner.normalise=sometimes")
