"""What holds of every on-policy learner."""

import copy

import pytest
import torch
import worlds
from cart_poles import CartPoles
from torchrl.envs import RewardSum, TransformedEnv

from coil_rl.learners import A2C, TRPO, GuideLoss, Reinforce
from coil_rl.schedules import Linear
from coil_rl.train.experiment import Experiment, watched_keys
from coil_rl.train.rollout import Rollout
from coil_rl.transforms import JumpStart, Takeover

LEARNERS = [A2C, TRPO, Reinforce]  # besides PPO, which has a file of its own


def weights(made):
    return torch.cat([p.detach().flatten() for net in (made.policy, made.critic) for p in net.parameters()])


def learned(learner, env, updates=2, steps=8, **options):
    """A learner after some updates."""
    torch.manual_seed(0)
    made = learner(env, **{"minibatches": 2} | options)
    rollout = Rollout(env, made.policy, steps, made.keys)
    for number in range(updates):
        made.update(rollout.collect(), number / updates)
    return made


@pytest.mark.parametrize("learner", LEARNERS)
def test_choices_that_pay_become_more_likely(learner):
    torch.manual_seed(0)
    env = CartPoles(16)
    # Without a discount of 0 it also pays to stay upright for longer.
    made = learner(env, learning_rate=1e-2, gamma=0.0, minibatches=4)
    rollout = Rollout(env, made.policy, 16, made.keys)
    for _ in range(12):
        batch = rollout.collect()
        batch["next", "reward"] = batch["action"].unsqueeze(-1).float()
        made.update(batch)
    assert rollout.collect()["action"].float().mean() > 0.8


@pytest.mark.parametrize("learner", LEARNERS)
def test_actions_that_pay_become_more_likely(learner):
    torch.manual_seed(0)
    env = worlds.cones(cars=16)
    made = learner(env, learning_rate=1e-2, gamma=0.0, minibatches=4)
    rollout = Rollout(env, made.policy, 8, made.keys)
    steering = []
    for _ in range(8):
        batch = rollout.collect()
        batch["next", "reward"] = batch["action"].clone()
        steering.append(batch["action"].mean().item())
        made.update(batch)
    assert steering[-1] > steering[0] + 0.1


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_state_goes_on_to_the_same_weights(learner):
    env = CartPoles(8)
    first, second = learned(learner, env), learner(env, minibatches=2, seed=5)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    batch = Rollout(env, first.policy, 16, first.keys).collect()
    assert first.update(batch.clone(), 0.5) == second.update(batch.clone(), 0.5)
    assert torch.equal(weights(first), weights(second))


class Killed(BaseException):
    pass


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_run_that_was_stopped_ends_with_the_files_of_one_that_never_was(learner, tmp_path):
    def experiment(name, seed=0):
        torch.manual_seed(seed)
        env = TransformedEnv(CartPoles(8, seed), RewardSum())
        made = learner(env, minibatches=2, learning_rate=Linear(1e-2, 0.0), seed=seed)
        rollout = Rollout(env, made.policy, 16, [*made.keys, *watched_keys(env, {})])
        (tmp_path / name).mkdir(exist_ok=True)
        return Experiment(made, rollout, 5 * rollout.frames, tmp_path / name, checkpoint_every=2)

    experiment("whole").run()
    stopped = experiment("stopped")
    update = stopped.learner.update

    def dying(batch, progress):
        if stopped.updates == 3:
            raise Killed
        return update(batch, progress)

    stopped.learner.update = dying
    with pytest.raises(Killed):
        stopped.run()
    again = experiment("stopped", seed=9)
    again.resume()
    again.run()
    for name in ("metrics.csv", "policy_last.pt", "policy_best.pt"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "stopped" / name).read_bytes(), name


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_guide_that_never_acts_changes_nothing_to_the_bit(learner):
    plain, shared = (learned(learner, worlds.cones(*transforms)) for transforms in ([], [JumpStart(0)]))
    assert torch.equal(weights(plain), weights(shared))


@pytest.mark.parametrize("learner", LEARNERS)
def test_steps_in_which_the_guide_acts_teach_the_critic_alone(learner):
    fresh, made = (learned(learner, worlds.cones(Takeover(1.0)), updates) for updates in (0, 1))
    for name, changes in [("policy", False), ("critic", True)]:
        nets = [getattr(of, name).parameters() for of in (fresh, made)]
        assert all(torch.equal(old, new) != changes for old, new in zip(*nets, strict=True))


def test_under_a_heavy_loss_it_does_as_the_guide_says():
    torch.manual_seed(0)
    env = worlds.cones(cars=16)
    made = A2C(env, auxiliary=[GuideLoss(100.0)], minibatches=8, learning_rate=1e-2)
    rollout = Rollout(env, made.policy, 16, made.keys)
    losses = [made.update(rollout.collect())["loss_guide"] for _ in range(6)]
    assert losses[-1] < losses[0] - 1


def test_an_entropy_bonus_keeps_a2c_undecided():
    def surest(entropy):
        env = CartPoles(16)
        made = learned(A2C, env, updates=20, learning_rate=1e-2, entropy=entropy)
        with torch.no_grad():
            return made.policy.get_dist(env.rollout(8).select("observation")).probs.max(-1).values.mean()

    assert surest(1.0) < surest(0.0)


def test_reinforce_learns_without_a_critic():
    made = learned(Reinforce, CartPoles(8), baseline="none")
    assert not list(made.critic.parameters())
    assert not made.state_dict()["critic"]


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize(
    ("name", "value"),
    [("gamma", 2), ("minibatches", 0), ("learning_rate", -1), ("action_scale", 0), ("max_grad_norm", float("inf"))],
)
def test_numbers_outside_their_range_are_refused(learner, name, value):
    with pytest.raises(ValueError, match=f"{name}={value} must be"):
        learner(CartPoles(2), **{name: value})


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_minibatch_of_one_frame_is_refused(learner):
    # The standard deviation of one advantage is NaN.
    learned(learner, CartPoles(2), steps=4, minibatches=4)
    with pytest.raises(ValueError, match="minibatches=5 leaves less than 2 of 8 frames to each"):
        learned(learner, CartPoles(2), steps=4, minibatches=5)


def test_other_values_outside_their_range_are_refused():
    with pytest.raises(ValueError, match="baseline='mean' must be critic or none"):
        Reinforce(CartPoles(2), baseline="mean")
    for name in ("entropy", "critic", "gae_lambda"):
        with pytest.raises(ValueError, match=f"{name}=-1 must be at least 0"):
            A2C(CartPoles(2), **{name: -1})
