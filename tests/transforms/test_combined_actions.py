import pytest
import torch
import worlds
from torchrl.envs.utils import step_mdp

from coil_rl.guides import SplineGuide
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("transform", "of_guide"),
    [
        (ResidualAction(scale=0.0), True),
        (MixedAction(weight=0.0), True),
        (MixedAction(weight=1.0), False),
    ],
    ids=["no residual", "guide only", "agent only"],
)
def test_without_one_of_both_actions_the_other_is_executed_exactly(transform, of_guide):
    guide = SplineGuide()
    combined = drive(worlds.cones(transform).train(), constant)
    alone = drive(
        worlds.cones(),
        lambda data: guide(data.select(*guide.in_keys))["action"] if of_guide else constant(data),
    )
    for key in ("observation", "reward", "done", "steering"):
        assert torch.equal(combined[key], alone[key])


def test_sum_is_clamped_to_the_bounds_of_the_action_and_the_data_keep_the_action_of_the_agent():
    assert (
        step(worlds.cones(ResidualAction(scale=5.0)).train(), 0.9)["next", "steering"] == 1
    ).all()
    env = worlds.pendulum(ResidualAction(scale=10.0)).train()
    check_env(env)
    assert env.transform.inv(env.reset().set("action", torch.tensor([2.0])))["action"].item() == 2.0
    after = step(worlds.cones(ResidualAction(scale=0.5)).train(), 0.25)
    assert (after["action"] == 0.25).all()
    torch.testing.assert_close(after["next", "steering"], after["guide_action"][:, 0] + 0.125)


@pytest.mark.parametrize(("progress", "weight"), [(0.0, 0.0), (0.25, 0.5), (0.5, 1.0), (1.0, 1.0)])
def test_weight_follows_its_schedule_in_training_and_has_its_final_value_in_evaluation(
    progress, weight
):
    transform = MixedAction(Linear(0.0, 1.0, until=0.5))
    env = worlds.cones(transform).train()
    transform.progress = progress
    after = step(env, 0.5)
    torch.testing.assert_close(
        after["next", "steering"], weight * 0.5 + (1 - weight) * after["guide_action"][:, 0]
    )
    assert (step(env.eval(), 0.5)["next", "steering"] == 0.5).all()


def test_takeover_executes_the_action_of_the_guide_where_the_agent_does_not_act():
    rollout = worlds.cones(Takeover(0.5, seed=1)).train().rollout(60, break_when_any_done=False)
    agent = rollout["agent_acts"]
    assert 0.4 < agent.float().mean() < 0.6
    expected = torch.where(agent, rollout["action"], rollout["guide_action"][..., 0, :])
    assert torch.equal(rollout["next", "steering"], expected)


def test_probability_and_horizon_follow_their_schedules():
    takeover, jump_start = (
        Takeover(Linear(1.0, 0.0, until=0.5)),
        JumpStart(Linear(20, 0, until=0.5)),
    )
    shared, jumping = worlds.cones(takeover).train(), worlds.cones(jump_start).train()
    for progress, agent, steps in ((0.0, False, 20), (0.5, True, 0), (1.0, True, 0)):
        takeover.progress = jump_start.progress = progress
        assert (shared.rollout(10, break_when_any_done=False)["agent_acts"] == agent).all()
        assert (jumping.reset()["guide_steps"] == steps).all()
    jump_start.progress = 0.25
    assert (jumping.reset()["guide_steps"] == 10).all()


@pytest.mark.parametrize(
    "transform", [Takeover(1.0), JumpStart(10)], ids=["takeover", "jump start"]
)
def test_agent_acts_alone_in_evaluation(transform):
    rollout = worlds.cones(transform).eval().rollout(15, break_when_any_done=False)
    assert rollout["agent_acts"].all()
    assert torch.equal(rollout["next", "steering"], rollout["action"])


@pytest.mark.slow
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
    bare = env.base_env
    assert rollout["next", "executed_action"].dtype == rollout["action"].dtype
    assert bare.full_action_spec["action"].shape == rollout["next", "executed_action"][:, 0].shape
    leaning = (rollout["observation"][..., 2] > 0).long()
    index = (
        rollout["next", "executed_action"]
        if categorical
        else rollout["next", "executed_action"].argmax(-1)
    )
    guide = ~rollout["agent_acts"].squeeze(-1)
    assert guide.any()
    assert torch.equal(index[guide], leaning[guide])


def test_guide_acts_in_the_first_steps_of_the_run_with_frames():
    env = worlds.cones(Takeover(1.0, 6 * 7)).train()
    first, second = (
        env.rollout(5, break_when_any_done=False),
        env.rollout(5, break_when_any_done=False),
    )
    assert not first["agent_acts"].any()
    assert torch.equal(
        second["agent_acts"][0].squeeze(-1), torch.tensor([False, False, True, True, True])
    )
    assert (
        worlds.cones(Takeover(1.0, 1000))
        .eval()
        .rollout(5, break_when_any_done=False)["agent_acts"]
        .all()
    )


def test_weight_of_the_agent_is_a_clipped_linear_function_of_the_uncertainty_in_the_step_before():
    env = worlds.cones(
        AdaptiveMixedAction(low=0.2, high=1.0, certain=0.1, uncertain=0.5, warm_up=0)
    ).train()
    doubt = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.5, 9.0]).unsqueeze(-1)
    carrier = env.reset()
    assert (carrier["agent_weight"] == 0.2).all()
    carrier = env.step(
        carrier.set("action", torch.full((6, 1), 0.5)).set(("next", "uncertainty"), doubt)
    )["next"]
    torch.testing.assert_close(
        carrier["agent_weight"].squeeze(-1), torch.tensor([1.0, 1.0, 0.8, 0.6, 0.2, 0.2])
    )
    after = env.step(carrier.set("action", torch.full((6, 1), 0.5)))
    weight, advice = carrier["agent_weight"], carrier["guide_action"][:, 0]
    torch.testing.assert_close(after["next", "steering"], weight * 0.5 + (1 - weight) * advice)
    assert (after["next", "agent_weight"] == 0.2).all(), (
        "without an uncertainty the guide is trusted"
    )


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
