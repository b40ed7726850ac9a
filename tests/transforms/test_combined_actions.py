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


@pytest.mark.parametrize(
    ("transform", "of_guide"),
    [(ResidualAction(scale=0.0), True), (MixedAction(weight=0.0), True), (MixedAction(weight=1.0), False)],
    ids=["no residual", "guide only", "agent only"],
)
def test_without_one_of_both_actions_the_other_is_executed_exactly(transform, of_guide):
    guide = SplineGuide()
    combined = drive(worlds.cones(transform).train(), constant)
    alone = drive(
        worlds.cones(), lambda data: guide(data.select(*guide.in_keys))["action"] if of_guide else constant(data)
    )
    for key in ("observation", "reward", "done", "steering"):
        assert torch.equal(combined[key], alone[key])


def test_sum_is_clamped_to_the_bounds_of_the_action_and_the_data_keep_the_action_of_the_agent():
    assert (step(worlds.cones(ResidualAction(scale=5.0)).train(), 0.9)["next", "steering"] == 1).all()
    env = worlds.pendulum(ResidualAction(scale=10.0)).train()
    check_env(env)
    assert env.transform.inv(env.reset().set("action", torch.tensor([2.0])))["action"].item() == 2.0
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


def test_takeover_executes_the_action_of_the_guide_where_the_agent_does_not_act():
    rollout = worlds.cones(Takeover(0.5, seed=1)).train().rollout(60, break_when_any_done=False)
    agent = rollout["agent_acts"]
    assert 0.4 < agent.float().mean() < 0.6
    expected = torch.where(agent, rollout["action"], rollout["guide_action"][..., 0, :])
    assert torch.equal(rollout["next", "steering"], expected)


def test_probability_and_horizon_follow_their_schedules():
    takeover, jump_start = Takeover(Linear(1.0, 0.0, until=0.5)), JumpStart(Linear(20, 0, until=0.5))
    shared, jumping = worlds.cones(takeover).train(), worlds.cones(jump_start).train()
    for progress, agent, steps in ((0.0, False, 20), (0.5, True, 0), (1.0, True, 0)):
        takeover.progress = jump_start.progress = progress
        assert (shared.rollout(10, break_when_any_done=False)["agent_acts"] == agent).all()
        assert (jumping.reset()["guide_steps"] == steps).all()
    jump_start.progress = 0.25
    assert (jumping.reset()["guide_steps"] == 10).all()


@pytest.mark.parametrize("transform", [Takeover(1.0), JumpStart(10)], ids=["takeover", "jump start"])
def test_agent_acts_alone_in_evaluation(transform):
    rollout = worlds.cones(transform).eval().rollout(15, break_when_any_done=False)
    assert rollout["agent_acts"].all()
    assert torch.equal(rollout["next", "steering"], rollout["action"])


def test_guide_acts_in_the_first_steps_of_every_episode_with_jump_start():
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


@pytest.mark.parametrize("categorical", [True, False])
def test_takeover_of_discrete_actions(categorical):
    env = worlds.carts(Takeover(1.0), categorical=categorical).train()
    first = env.rollout(5)[:, 0]
    sent = env.transform.inv(first.clone())["action"]
    leaning = (first["observation"][..., 2] > 0).long()
    assert torch.equal(sent if categorical else sent.long().argmax(-1), leaning)
    assert sent.dtype == first["action"].dtype
