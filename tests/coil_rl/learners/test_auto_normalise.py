"""Observations in physical units: decided on the first batch, said, and kept with the policy."""

from functools import partial

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from odd_parts import Plain
from tensordict import TensorDict

import coil_rl
from coil_rl.learners.normaliser import Moments

TINY = ["budget.num_envs=4", "budget.steps=16", "evaluation.cases=2", "logger=none"]
TINY += ["evaluation.curve.num_envs=2", "evaluation.curve.points=1", "evaluation.gif=false"]
TINY += ["checkpoint_every=1", "learner.minibatches=2"]


class Reactor(Plain):
    """A temperature and a height: in kelvin and metres, or in units of their own."""

    observation_space = Box(-np.inf, np.inf, (2,), np.float32)

    def __init__(self, offset=(0.0, 0.0), unit=(1.0, 1.0)):
        self.offset, self.unit = np.array(offset), np.array(unit)

    def look(self):
        return (self.offset + self.unit * super().look()).astype(np.float32)


PHYSICAL = partial(Reactor, (322.0, 7000.0), (0.5, 900.0))


def learned(env, folder, *overrides, frames=128):
    words = [*TINY, *overrides]
    run = coil_rl.prepare(env, method="ppo", frames=frames, folder=folder, overrides=words)
    run.begin()
    run.learn()
    return run


@pytest.mark.slow
def test_observations_in_scale_stay_as_they_are(tmp_path, capsys):
    run = learned(Reactor, tmp_path / "auto")
    assert "normalise: observation is in scale and stays as it is" in capsys.readouterr().err
    (moments,) = (each for each in run.policy().modules() if isinstance(each, Moments))
    assert not moments.used
    raw = learned(Reactor, tmp_path / "raw", "learner.normalise=false")
    state, expected = run.policy().state_dict(), raw.policy().state_dict()
    for key, value in expected.items():
        found = [state[name] for name in state if name.endswith(key.split(".", 2)[2])]
        assert any(torch.equal(value, each) for each in found)


@pytest.mark.slow
def test_raw_observations_far_out_of_scale_are_named(tmp_path):
    said = r"\[0\] mean 32\d.* deviation .*, \[1\] mean .*; use learner.normalise=auto or true"
    with pytest.warns(UserWarning, match=f"far out of scale for a network: {said}"):
        learned(PHYSICAL, tmp_path / "run", "learner.normalise=false")


def test_steps_before_learning_decide_together_with_replay(capsys):
    env = coil_rl.GymnasiumEnv("Pendulum-v1", num_envs=2)
    sac = coil_rl.SAC(env, normalise="auto", starts=96)
    (moments,) = sac.normaliser.moments

    def learn(mean, deviation):
        batch = mean + deviation * torch.tensor([[-1.0], [1.0]]).repeat(16, 3)
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

    def look(self):
        return (10.0 ** min(self.begun - 1, 4) * super().look()).astype(np.float32)


@pytest.mark.slow
def test_observations_that_leave_their_scale_later_are_named_once(tmp_path):
    with pytest.warns(UserWarning, match="out of scale") as found:
        learned(Drifting, tmp_path / "run", "budget.steps=8", frames=512)
    texts = [str(each.message) for each in found]
    named = [text for text in texts if "far out of scale for a network: [0] mean" in text]
    assert len(named) == 1
    assert named[0].endswith("; use learner.normalise=true")


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
        (9.0, 64.0, True),  # its size is above 10
    ],
)
def test_what_is_out_of_scale(mean, variance, wrong):
    moments = Moments(torch.Size([1]))
    moments.mean.fill_(mean)
    moments.variance.fill_(variance)
    assert moments.out_of_scale.tolist() == [wrong]
