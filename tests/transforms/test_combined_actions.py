import pytest
import torch
import worlds
from torchrl.envs.utils import step_mdp

from coil_rl.guides import SplineGuide
from coil_rl.schedules import Linear
from coil_rl.testing import check_env
from coil_rl.transforms import JumpStart, MixedAction, ResidualAction, Takeover


def drive(env, policy, steps=40):
    """Entries after each step when `policy` acts on the observation."""
    carrier, after = env.reset(), []
    for _ in range(steps):
        step = env.step(carrier.set("action", policy(carrier)))
        after.append(step["next"])
        carrier = step_mdp(step)
    return torch.stack(after, 1)


def constant(carrier):
    return torch.full_like(carrier["steering"], 0.9)


def step(env, action):
    return env.step(env.reset().set("action", torch.full((6, 1), action)))


@pytest.mark.parametrize("transform", [ResidualAction(scale=0.0), MixedAction(weight=0.0)], ids=["residual", "mixed"])
def test_without_the_agents_action_the_guide_drives_exactly(transform):
    combined = drive(worlds.cones(transform).train(), constant)
    guide = SplineGuide()
    alone = drive(worlds.cones(), lambda carrier: guide(carrier.select(*guide.in_keys))["action"])
    for key in ("observation", "reward", "done", "steering"):
        assert torch.equal(combined[key], alone[key])


def test_without_the_guides_action_the_agent_drives_exactly():
    mixed, alone = drive(worlds.cones(MixedAction(1.0)).train(), constant), drive(worlds.cones(), constant)
    assert torch.equal(mixed["observation"], alone["observation"])


def test_the_sum_is_clamped_to_the_bounds_of_the_action():
    assert (step(worlds.cones(ResidualAction(scale=5.0)).train(), 0.9)["next", "steering"] == 1).all()
    env = worlds.pendulum(ResidualAction(scale=10.0)).train()
    check_env(env)
    assert env.transform.inv(env.reset().set("action", torch.tensor([2.0])))["action"].item() == 2.0


def test_the_data_keep_the_agents_action():
    after = step(worlds.cones(ResidualAction(scale=0.5)).train(), 0.25)
    assert (after["action"] == 0.25).all()
    torch.testing.assert_close(after["next", "steering"], after["guide_action"][:, 0] + 0.125)


@pytest.mark.parametrize(("progress", "weight"), [(0.0, 0.0), (0.25, 0.5), (0.5, 1.0), (1.0, 1.0)])
def test_weight_follows_its_schedule_in_training_and_has_its_final_value_in_evaluation(progress, weight):
    transform = MixedAction(Linear(0.0, 1.0, until=0.5))
    env = worlds.cones(transform).train()
    transform.progress = progress
    after = step(env, 0.5)
    torch.testing.assert_close(after["next", "steering"], weight * 0.5 + (1 - weight) * after["guide_action"][:, 0])
    assert (step(env.eval(), 0.5)["next", "steering"] == 0.5).all()


def test_discrete_actions_cannot_be_added():
    with pytest.raises(ValueError, match="ResidualAction needs continuous actions, but this env has 2 discrete ones"):
        worlds.carts(ResidualAction()).rollout(1)


def test_takeover_sends_the_guides_action_where_the_agent_does_not_act():
    rollout = worlds.cones(Takeover(0.5, seed=1)).train().rollout(60, break_when_any_done=False)
    agent = rollout["agent_acts"]
    assert 0.4 < agent.float().mean() < 0.6
    assert torch.equal(
        rollout["next", "steering"], torch.where(agent, rollout["action"], rollout["guide_action"][..., 0, :])
    )


def test_takeover_probability_follows_its_schedule():
    transform = Takeover(Linear(1.0, 0.0, until=0.5))
    env = worlds.cones(transform).train()
    for progress, agent in ((0.0, False), (0.5, True), (1.0, True)):
        transform.progress = progress
        assert (env.rollout(20, break_when_any_done=False)["agent_acts"] == agent).all()


@pytest.mark.parametrize("transform", [Takeover(1.0), JumpStart(10)], ids=["takeover", "jump start"])
def test_in_evaluation_the_agent_acts_alone(transform):
    rollout = worlds.cones(transform).eval().rollout(15, break_when_any_done=False)
    assert rollout["agent_acts"].all()
    assert torch.equal(rollout["next", "steering"], rollout["action"])


def test_jump_start_gives_the_first_steps_of_every_episode_to_the_guide():
    rollout = worlds.cones(JumpStart(7)).train().rollout(150, break_when_any_done=False)
    ended = rollout["next", "done"].squeeze(-1)
    assert ended.sum() > 6, "random driving should have crashed, so that later episodes are covered"
    for agent, done in zip(rollout["agent_acts"].squeeze(-1), ended, strict=True):
        starts = [0, *(done.nonzero().flatten() + 1).tolist()]
        for first, end in zip(starts, [*starts[1:], 150], strict=True):
            assert torch.equal(agent[first:end], torch.arange(end - first) >= 7)


def test_random_horizon_is_uniform():
    env = worlds.cones(JumpStart(3, random=True, seed=2), cars=64).train()
    steps = torch.cat([env.reset()["guide_steps"] for _ in range(40)])
    assert steps.unique().tolist() == [0, 1, 2, 3]
    assert (steps.flatten().bincount() / len(steps) - 0.25).abs().max() < 0.03


def test_horizon_follows_its_schedule():
    transform = JumpStart(Linear(20, 0, until=0.5))
    env = worlds.cones(transform).train()
    for progress, steps in ((0.0, 20), (0.25, 10), (0.5, 0), (1.0, 0)):
        transform.progress = progress
        assert (env.reset()["guide_steps"] == steps).all()


@pytest.mark.parametrize("make", [lambda seed: Takeover(0.5, seed=seed), lambda seed: JumpStart(9, True, seed=seed)])
def test_draws_continue_from_a_state_dict(make):
    env, again = worlds.cones(make(3)).train(), worlds.cones(make(4)).train()
    env.rollout(3)
    again.load_state_dict(env.state_dict())
    assert torch.equal(env.rollout(8)["agent_acts"], again.rollout(8)["agent_acts"])


@pytest.mark.parametrize("categorical", [True, False])
def test_takeover_of_discrete_actions(categorical):
    env = worlds.carts(Takeover(1.0), categorical=categorical).train()
    first = env.rollout(5)[:, 0]
    sent = env.transform.inv(first.clone())["action"]
    leaning = (first["observation"][..., 2] > 0).long()
    assert torch.equal(sent if categorical else sent.long().argmax(-1), leaning)
    assert sent.dtype == first["action"].dtype


@pytest.mark.parametrize("make", [lambda: Takeover(0.5), lambda: JumpStart(4, random=True)])
def test_specs_hold_in_every_env(make):
    for env in worlds.everywhere(make):
        check_env(env.train())
