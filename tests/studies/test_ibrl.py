import copy
import re

import pytest
import torch
import worlds
from torchrl.envs import PendulumEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.learners.policy import Entries
from coil_rl.run.policy_batch import policy_batch
from coil_rl.run.rollout import Rollout
from coil_studies import IBRL

SEEN = ["th", "thdot"]
RANDOM, DETERMINISTIC = ExplorationType.RANDOM, ExplorationType.DETERMINISTIC


def make(**options):
    torch.manual_seed(0)
    env = worlds.pendulum()
    given = {"hidden": [16], "starts": 0, "batch_size": 16, "updates_per_step": 0.0625}
    ibrl = IBRL(env, SEEN, **given | {"action_gain": 1.0} | options)
    with torch.no_grad():  # critics and target networks must differ
        vector = ibrl.of_critics.vector
        vector.add_(torch.randn_like(vector), alpha=0.5)
    return ibrl, Rollout(env, ibrl.policy, 64, ibrl.keys)


def target_values(ibrl, states, action):
    """Smallest value of an action by the target networks, [N]."""
    entries = Entries({key: states[key] for key in SEEN} | {"action": action})
    return ibrl.target.values(entries).amin(0)


def own_action(ibrl, states):
    return ibrl.actor(Entries({key: states[key] for key in SEEN}))["action"]


def test_better_proposal_of_guide_and_policy_is_executed():
    ibrl, rollout = make(critics=3)
    batch = rollout.collect()
    guide = batch["guide_action"][:, 0]
    with set_exploration_type(DETERMINISTIC):
        own = own_action(ibrl, batch)
        chosen = ibrl.policy(batch.select(*SEEN, "guide_action"))["action"]
    better = target_values(ibrl, batch, guide) >= target_values(ibrl, batch, own)
    assert 5 < better.sum() < 60
    assert torch.equal(chosen, torch.where(better.unsqueeze(-1), guide, own))


@pytest.mark.parametrize("sharpness", [None, 0.0, 2.0])
def test_critics_learn_the_value_of_the_choice_in_the_next_state(sharpness):
    """y = r + gamma * max of min Q', or mean over softmax(sharpness * min Q'), without entropy."""
    ibrl, rollout = make(gamma=0.9, sharpness=sharpness, temperature=5.0)
    steps = rollout.collect().select(*ibrl.keys)
    steps["next", "terminated"][::3] = True
    data, after = Entries(steps.items(True, True)), steps["next"]
    torch.manual_seed(1)
    with torch.no_grad(), set_exploration_type(RANDOM):
        own = own_action(ibrl, after)
        proposals = (after["guide_action"][:, 0], own)
        values = torch.stack([target_values(ibrl, after, action) for action in proposals])
    value = values.amax(0)
    if sharpness is not None:
        value = ((sharpness * values).softmax(0) * values).sum(0)
    expected = after["reward"] + 0.9 * ~after["terminated"] * value.unsqueeze(-1)
    with torch.no_grad():
        values = ibrl.critics.values(data)
        torch.manual_seed(1)
        loss = ibrl.losses(data)["loss_qvalue"]
    torch.testing.assert_close(loss, (values - expected.squeeze(-1)).square().sum(0).mean())


def test_proposals_are_drawn_by_the_sharpness_of_the_choice_in_training_only():
    ibrl, rollout = make(sharpness=0.0)
    batch = rollout.collect()
    guide = batch["guide_action"][:, 0]
    with set_exploration_type(RANDOM):
        drawn = torch.cat([ibrl.policy(batch.copy())["action"] == guide for _ in range(20)])
    assert abs(drawn.float().mean() - 0.5) < 0.05
    assert ibrl.update(rollout.collect())["guide_share"] == pytest.approx(0.5)
    with set_exploration_type(DETERMINISTIC):
        first, second = (ibrl.policy(batch.copy())["action"] for _ in range(2))
    assert torch.equal(first, second)


def test_edited_action_stays_near_the_guide_and_learns_to_have_a_larger_value():
    ibrl, rollout = make(edit=0.25, temperature=1e-3, learning_rate=3e-3, tau=0.0)
    batch = rollout.collect()
    guide, proposals = batch["guide_action"][:, 0], ibrl.proposals

    def edited():
        with torch.no_grad(), set_exploration_type(DETERMINISTIC):
            return proposals.rate(batch)[0][2]

    def gain():
        seen = batch.select(*SEEN)
        actions = [seen.copy().set("action", each).to_dict() for each in (edited(), guide)]
        ours, theirs = (ibrl.critics.values(Entries(each)).amin(0) for each in actions)
        return (ours - theirs).mean()

    assert ((edited() - guide).abs() <= 0.25 * 2 + 1e-6).all()  # the torque is within 2
    first, (weights,) = gain(), ibrl.of_editor
    assert any(each is weights.vector for each in ibrl.gradient.parameters)
    optimiser = torch.optim.Adam([weights.vector], 1e-2)
    for _ in range(60):
        optimiser.zero_grad()
        ibrl.losses(Entries(batch.items(True, True)))["loss_actor"].backward()
        optimiser.step()
    assert gain() > first + 0.01


@pytest.mark.parametrize(
    "options", [{"edit": 0.2}, {"normalise": True}], ids=["edit", "normalised"]
)
def test_state_of_the_policy_is_complete(options):
    first, rollout = make(**options)
    first.update(rollout.collect())
    batch = rollout.collect()
    policies = policy_batch(first.policy, [first.policy.state_dict()] * 2)
    second, _ = make(**options)
    second.policy.load_state_dict(copy.deepcopy(first.policy.state_dict()))
    shown = batch.select(*SEEN, "guide_action")
    with set_exploration_type(DETERMINISTIC):
        chosen = [each(shown.copy())["action"] for each in (first.policy, second.policy, policies)]
    assert torch.equal(chosen[0], chosen[1])
    torch.testing.assert_close(chosen[0], chosen[2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"target_critics": 1}, "IBRL compares all critics; leave target_critics"),
        ({"uncertainty": True}, "IBRL compares all critics"),
        ({"edit": -0.1}, "edit=-0.1 must be"),
        ({"sharpness": -1}, "sharpness=-1 must be"),
    ],
)
def test_invalid_options_are_refused(options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make(**options)


def test_env_without_advice_is_refused():
    with pytest.raises(KeyError, match="IBRL reads row 0 of guide_action, but there is no advice"):
        IBRL(PendulumEnv(), ["th"])
