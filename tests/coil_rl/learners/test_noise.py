import math

import pytest
import torch
from cart_poles import CartPoles
from tensordict import TensorDict

from coil_rl.envs import ConeTrackEnv
from coil_rl.learners import A2C, PPO, TRPO, NoiseDecay, Reinforce
from coil_rl.train.rollout import Rollout


def batch(failed, ended=10):
    """Return a batch in which some episodes end, `failed` of them by a failure."""
    done, terminated = torch.zeros(2, 16, 1, 1, dtype=torch.bool)
    done[:ended], terminated[:failed] = True, True
    return TensorDict({"next": {"done": done, "terminated": terminated}}, [16, 1])


def decay_of(learner, scale=0.5, **options):
    noise = NoiseDecay(0.05, tolerance=0.1, episodes=20, **options)
    noise.attach(learner.policy)
    noise.scales[0].data.fill_(math.log(scale))
    return noise


@pytest.fixture
def learner(rings):
    return PPO(ConeTrackEnv(rings, 16, rate=6))


def test_noise_is_untouched_while_episodes_fail(learner):
    noise = decay_of(learner)
    assert [noise.apply(batch(failed=5), step / 10) for step in range(10)] == pytest.approx([0.5] * 10)


def test_noise_falls_exponentially_to_its_end_once_failures_have_stopped(learner):
    noise = decay_of(learner)
    noise.apply(batch(failed=10), 0.1)
    assert noise.apply(batch(failed=0), 0.2) == pytest.approx(0.5)
    assert noise.apply(batch(failed=0), 0.5) == pytest.approx(0.5), "the last 20 episodes have no failure from here on"
    assert noise.apply(batch(failed=0), 0.75) == pytest.approx((0.5 * 0.05) ** 0.5)
    assert noise.apply(batch(failed=10), 1.0) == pytest.approx(0.05), "a later failure does not stop it"


def test_noise_that_is_lower_already_is_left_alone(learner):
    noise = decay_of(learner, scale=0.02)
    for step in range(5):
        assert noise.apply(batch(failed=0), step / 4) == pytest.approx(0.02)


def test_resumed_schedule_continues(learner):
    first, second = decay_of(learner), decay_of(learner)
    for step in range(4):
        first.apply(batch(failed=0), step / 8)
    second.load_state_dict(first.state_dict())
    assert second.apply(batch(failed=0), 0.8) == pytest.approx(first.apply(batch(failed=0), 0.8))


@pytest.mark.parametrize("kind", [PPO, A2C, Reinforce, TRPO])
def test_every_learner_with_such_noise_reports_and_limits_it(kind, rings):
    torch.manual_seed(0)
    env = ConeTrackEnv(rings, 16, rate=6, time_limit=1)
    noise = NoiseDecay(0.01, tolerance=1.0, episodes=1)
    learner = kind(env, minibatches=2, noise=noise)
    rollout = Rollout(env, learner.policy, 8, learner.keys)
    reported = [learner.update(rollout.collect(), progress)["noise"] for progress in (0.5, 1.0)]
    assert reported == [pytest.approx(0.5, rel=0.1), pytest.approx(0.01)]
    assert float(noise.scales[0].detach().exp()) == pytest.approx(0.01)


def test_discrete_actions_and_values_out_of_range_are_refused():
    with pytest.raises(ValueError, match="noise: discrete actions have no standard deviation to limit; leave it out"):
        PPO(CartPoles(4), noise=NoiseDecay())
    with pytest.raises(ValueError, match="end=0"):
        NoiseDecay(0)
