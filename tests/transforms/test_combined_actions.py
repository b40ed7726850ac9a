import pytest
import torch
import worlds

from coil_rl.schedules import Linear
from coil_rl.testing import check_env
from coil_rl.transforms import (
    AdaptiveMixedAction,
    DiscreteActions,
    GradualResidual,
    JumpStart,
    MixedAction,
    ResidualAction,
    Takeover,
    set_progress,
)


def step(env, action):
    return env.step(env.reset().set("action", torch.full((6, 1), action)))


def test_sum_is_clamped_to_the_bounds_of_the_action_and_the_data_keep_the_action_of_the_agent():
    after = step(worlds.cones(ResidualAction(scale=5.0)).train(), 0.9)
    assert (after["next", "steering"] == 1).all()
    env = worlds.pendulum(ResidualAction(scale=10.0)).train()
    check_env(env)
    assert env.transform.inv(env.reset().set("action", torch.tensor([2.0])))["action"].item() == 2.0
    after = step(worlds.cones(ResidualAction(scale=0.5)).train(), 0.25)
    assert (after["action"] == 0.25).all()
    torch.testing.assert_close(after["next", "steering"], after["guide_action"][:, 0] + 0.125)


@pytest.mark.parametrize(("progress", "weight"), [(0.0, 0.0), (0.25, 0.5), (0.5, 1.0), (1.0, 1.0)])
def test_weight_follows_its_schedule_and_has_its_final_value_in_evaluation(progress, weight):
    env = worlds.cones(MixedAction(Linear(0.0, 1.0, until=0.5))).train()
    set_progress(env, progress)
    after = step(env, 0.5)
    mixed = weight * 0.5 + (1 - weight) * after["guide_action"][:, 0]
    assert torch.equal(after["next", "steering"], mixed)
    assert (step(env.eval(), 0.5)["next", "steering"] == 0.5).all()


def test_takeover_executes_the_action_of_the_guide_where_the_agent_does_not_act():
    rollout = worlds.cones(Takeover(0.5, seed=1)).train().rollout(60, break_when_any_done=False)
    agent = rollout["agent_acts"]
    assert 0.4 < agent.float().mean() < 0.6
    expected = torch.where(agent, rollout["action"], rollout["guide_action"][..., 0, :])
    assert torch.equal(rollout["next", "steering"], expected)


def test_probability_and_horizon_follow_their_schedules():
    shared = worlds.cones(Takeover(Linear(1.0, 0.0, until=0.5))).train()
    jumping = worlds.cones(JumpStart(Linear(20, 0, until=0.5))).train()
    for progress, agent in ((0.0, False), (0.5, True), (1.0, True)):
        set_progress(shared, progress)
        assert (shared.rollout(10, break_when_any_done=False)["agent_acts"] == agent).all()
    for progress, steps in ((0.0, 20), (0.25, 10), (0.5, 0), (1.0, 0)):
        set_progress(jumping, progress)
        assert (jumping.reset()["guide_steps"] == steps).all()


@pytest.mark.parametrize("make", [Takeover, lambda: Takeover(1.0, 1000), lambda: JumpStart(10)])
def test_agent_acts_alone_in_evaluation(make):
    rollout = worlds.cones(make()).eval().rollout(15, break_when_any_done=False)
    assert rollout["agent_acts"].all()
    assert torch.equal(rollout["next", "steering"], rollout["action"])


@pytest.mark.slow
def test_guide_acts_in_the_first_steps_of_every_episode_with_jump_start():
    rollout = worlds.cones(JumpStart(7)).train().rollout(150, break_when_any_done=False)
    ended = rollout["next", "done"].squeeze(-1)
    assert ended.sum() > 6, "later episodes should be covered"
    for agent, done in zip(rollout["agent_acts"].squeeze(-1), ended, strict=True):
        starts = [0, *(done.nonzero().flatten() + 1).tolist()]
        for first, end in zip(starts, [*starts[1:], 150], strict=True):
            assert torch.equal(agent[first:end], torch.arange(end - first) >= 7)


def test_random_horizon_is_uniform():
    env = worlds.cones(JumpStart(3, random=True, seed=2), cars=64).train()
    steps = torch.cat([env.reset()["guide_steps"] for _ in range(40)])
    assert steps.unique().tolist() == [0, 1, 2, 3]
    assert (steps.flatten().bincount() / len(steps) - 0.25).abs().max() < 0.03


COMBINED = {
    "residual": lambda: [ResidualAction(0.5)],
    "mixed": lambda: [MixedAction(0.5)],
    "adaptive": lambda: [AdaptiveMixedAction(warm_up=60)],
    "takeover": lambda: [Takeover(0.5)],
    "jump start": lambda: [JumpStart(5)],
    "warm start": lambda: [Takeover(1.0, 60)],
    "gradual residual": lambda: [GradualResidual(0.5, probability=0.5)],
    "residual and takeover": lambda: [Takeover(0.5), ResidualAction(0.5)],
    "choices": lambda: [Takeover(0.5), DiscreteActions(3)],
}


@pytest.mark.fast(3)
@pytest.mark.parametrize("name", COMBINED)
@pytest.mark.parametrize("training", [True, False], ids=["training", "evaluation"])
def test_executed_action_is_the_one_the_env_was_given(name, training):
    env = worlds.cones(*COMBINED[name]()).train(training)
    set_progress(env, 0.2)
    rollout = env.rollout(20, break_when_any_done=False)
    executed = rollout["next", "executed_action"]
    assert torch.equal(executed, rollout["next", "steering"])
    assert (rollout["executed_action"][:, 0] == 0).all()
    if training:
        assert not torch.equal(executed, rollout["action"])


@pytest.mark.parametrize("categorical", [True, False])
def test_executed_action_of_choices_is_a_choice(categorical):
    env = worlds.carts(Takeover(0.5, seed=3), categorical=categorical).train()
    rollout = env.rollout(8)
    executed = rollout["next", "executed_action"]
    assert executed.dtype == rollout["action"].dtype
    assert executed[:, 0].shape == env.base_env.full_action_spec["action"].shape
    leaning = (rollout["observation"][..., 2] > 0).long()
    index = executed if categorical else executed.argmax(-1)
    guide = ~rollout["agent_acts"].squeeze(-1)
    assert guide.any()
    assert torch.equal(index[guide], leaning[guide])


def test_guide_acts_in_the_first_steps_of_the_run_with_frames():
    env = worlds.cones(Takeover(1.0, 6 * 7)).train()
    first, second = (env.rollout(5, break_when_any_done=False)["agent_acts"] for _ in range(2))
    assert not first.any()
    assert second[0].flatten().tolist() == [False, False, True, True, True]


def test_weight_of_the_agent_is_a_clipped_linear_function_of_the_uncertainty_in_the_step_before():
    env = worlds.cones(AdaptiveMixedAction(certain=0.1, uncertain=0.5, warm_up=0)).train()
    doubt = torch.tensor([[0.0], [0.1], [0.2], [0.3], [0.5], [9.0]])
    action = torch.full((6, 1), 0.5)
    carrier = env.reset()
    assert (carrier["agent_weight"] == 0.2).all()
    carrier = env.step(carrier.set("action", action).set(("next", "uncertainty"), doubt))["next"]
    weight, advice = carrier["agent_weight"], carrier["guide_action"][:, 0]
    assert weight.flatten().tolist() == pytest.approx([1, 1, 0.8, 0.6, 0.2, 0.2])
    after = env.step(carrier.set("action", action))["next"]
    torch.testing.assert_close(after["steering"], weight * 0.5 + (1 - weight) * advice)
    assert (after["agent_weight"] == 0.2).all(), "without an uncertainty the guide is trusted"


def test_weight_of_the_agent_is_drawn_during_the_warm_up():
    env = worlds.cones(AdaptiveMixedAction(warm_up=64 * 20), cars=64).train()
    weights = env.rollout(30, break_when_any_done=False)["next", "agent_weight"]
    warm, later = weights[:, :20], weights[:, 20:]
    assert ((warm >= 0.2) & (warm <= 0.3)).all()
    assert abs(warm.mean() - 0.25) < 0.01
    assert (later == 0.2).all()


@pytest.mark.slow
def test_residual_is_mixed_in_by_its_probability_and_always_in_evaluation():
    env = worlds.cones(GradualResidual(0.5, probability=Linear(1.0, 0.0))).train()
    for progress, share in ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0)):
        set_progress(env, progress)
        rollout = env.rollout(60, break_when_any_done=False)
        assert abs(rollout["agent_acts"].float().mean() - share) < 0.1
        guide = rollout["guide_action"][..., 0, :]
        expected = (guide + 0.5 * rollout["agent_acts"] * rollout["action"]).clamp(-1, 1)
        torch.testing.assert_close(rollout["next", "executed_action"], expected)
    assert env.eval().rollout(5, break_when_any_done=False)["agent_acts"].all()
