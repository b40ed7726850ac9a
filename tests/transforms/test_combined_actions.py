import pytest
import torch
import worlds
from torchrl.envs.utils import step_mdp

from coil_rl.guides import SplineGuide
from coil_rl.schedules import Linear
from coil_rl.testing import check_env
from coil_rl.transforms import MixedAction, ResidualAction


def drive(env, act, steps=40):
    """Rewards and poses when `act` chooses from what the env wrote."""
    carrier, after = env.reset(), []
    for _ in range(steps):
        step = env.step(carrier.set("action", act(carrier)))
        after.append(step["next"])
        carrier = step_mdp(step)
    return torch.stack(after, 1)


def anything(carrier):
    return torch.full_like(carrier["steering"], 0.9)


@pytest.mark.parametrize("transform", [ResidualAction(scale=0.0), MixedAction(weight=0.0)], ids=["residual", "mixed"])
def test_without_the_agents_part_the_guide_drives_exactly(transform):
    combined = drive(worlds.cones(transform).train(), anything)
    guide = SplineGuide()
    alone = drive(worlds.cones(), lambda seen: guide(seen.select(*guide.in_keys))["action"])
    for key in ("observation", "reward", "done", "steering"):
        assert torch.equal(combined[key], alone[key])


def test_without_the_guides_part_the_agent_drives_exactly():
    mixed, alone = drive(worlds.cones(MixedAction(1.0)).train(), anything), drive(worlds.cones(), anything)
    assert torch.equal(mixed["observation"], alone["observation"])


def test_the_sum_is_clipped_to_what_the_env_takes():
    after = drive(worlds.cones(ResidualAction(scale=5.0)).train(), anything, steps=3)
    assert (after["steering"] == 1).all()


def test_the_data_keep_the_agents_own_action():
    env = worlds.cones(ResidualAction(scale=0.5)).train()
    step = env.step(env.reset().set("action", torch.full((6, 1), 0.25)))
    assert (step["action"] == 0.25).all()
    torch.testing.assert_close(step["next", "steering"], step["guide_action"][:, 0] + 0.125)


@pytest.mark.parametrize(("progress", "weight"), [(0.0, 0.0), (0.25, 0.5), (0.5, 1.0), (1.0, 1.0)])
def test_weight_follows_its_schedule(progress, weight):
    transform = MixedAction(Linear(0.0, 1.0, until=0.5))
    env = worlds.cones(transform).train()
    transform.progress = progress
    step = env.step(env.reset().set("action", torch.full((6, 1), 0.5)))
    torch.testing.assert_close(step["next", "steering"], weight * 0.5 + (1 - weight) * step["guide_action"][:, 0])


def test_evaluation_takes_the_value_that_a_schedule_ends_with():
    env = worlds.cones(MixedAction(Linear(0.0, 1.0))).eval()
    step = env.step(env.reset().set("action", torch.full((6, 1), 0.5)))
    assert (step["next", "steering"] == 0.5).all()


def test_torque_is_bounded_by_the_pendulums_own_limits():
    env = worlds.pendulum(ResidualAction(scale=10.0)).train()
    check_env(env)
    carrier = env.reset()
    assert env.transform.inv(carrier.set("action", torch.tensor([2.0])))["action"].item() == 2.0


def test_choices_cannot_be_added_up():
    with pytest.raises(ValueError, match="ResidualAction adds actions up, but this env takes one of 2 choices"):
        worlds.carts(ResidualAction()).rollout(1)
