import pytest
import torch
import worlds

from coil_rl.schedules import Linear
from coil_rl.testing import check_env
from coil_rl.transforms import JumpStart, Takeover


def test_the_env_gets_the_guides_action_just_where_the_data_say_so():
    rollout = worlds.cones(Takeover(0.5, seed=1)).train().rollout(60, break_when_any_done=False)
    agent = rollout["agent_acts"]
    assert 0.4 < agent.float().mean() < 0.6
    driven = torch.where(agent, rollout["action"], rollout["guide_action"][..., 0, :])
    # An episode that ends shows the last steering, too: the env resets only afterwards.
    assert torch.equal(rollout["next", "steering"], driven)


@pytest.mark.parametrize(("probability", "agent"), [(0.0, True), (1.0, False)])
def test_who_acts_is_certain_at_both_ends(probability, agent):
    rollout = worlds.cones(Takeover(probability)).train().rollout(40, break_when_any_done=False)
    assert (rollout["agent_acts"] == agent).all()


def test_probability_follows_its_schedule():
    transform = Takeover(Linear(1.0, 0.0, until=0.5))
    env = worlds.cones(transform).train()
    for progress, agent in ((0.0, False), (0.5, True), (1.0, True)):
        transform.progress = progress
        assert (env.rollout(5)["agent_acts"] == agent).all()


@pytest.mark.parametrize("transform", [Takeover(1.0), JumpStart(10)], ids=["takeover", "jump start"])
def test_the_agent_alone_is_evaluated(transform):
    rollout = worlds.cones(transform).eval().rollout(15, break_when_any_done=False)
    assert rollout["agent_acts"].all()
    assert torch.equal(rollout["next", "steering"], rollout["action"])


def test_the_guide_drives_the_first_steps_of_every_episode():
    env = worlds.cones(JumpStart(7)).train()
    rollout = env.rollout(150, break_when_any_done=False)
    ended = rollout["next", "done"].squeeze(-1)
    assert ended.sum() > 6, "random driving should have crashed, so that later episodes are covered"
    for agent, done in zip(rollout["agent_acts"].squeeze(-1), ended, strict=True):
        begins = [0, *(done.nonzero().flatten() + 1).tolist()]
        for first, end in zip(begins, [*begins[1:], 150], strict=True):
            expected = torch.arange(end - first) >= 7
            assert torch.equal(agent[first:end], expected)


def test_a_random_horizon_is_uniform_between_none_and_all_of_it():
    env = worlds.cones(JumpStart(3, random=True, seed=2), cars=64).train()
    steps = torch.cat([env.reset()["guide_steps"] for _ in range(40)])
    assert steps.unique().tolist() == [0, 1, 2, 3]
    assert (steps.flatten().bincount() / len(steps) - 0.25).abs().max() < 0.03


def test_a_falling_horizon_is_a_curriculum():
    transform = JumpStart(Linear(20, 0, until=0.5))
    env = worlds.cones(transform).train()
    for progress, steps in ((0.0, 20), (0.25, 10), (0.5, 0), (1.0, 0)):
        transform.progress = progress
        assert (env.reset()["guide_steps"] == steps).all()


@pytest.mark.parametrize("make", [lambda seed: Takeover(0.5, seed=seed), lambda seed: JumpStart(9, True, seed=seed)])
def test_draws_go_on_where_a_state_dict_left_them(make):
    env, again = worlds.cones(make(3)).train(), worlds.cones(make(4)).train()
    env.rollout(3)
    again.load_state_dict(env.state_dict())
    assert torch.equal(env.rollout(8)["agent_acts"], again.rollout(8)["agent_acts"])


@pytest.mark.parametrize("categorical", [True, False])
def test_a_guide_takes_over_choices_as_well(categorical):
    env = worlds.carts(Takeover(1.0), categorical=categorical).train()
    seen = env.rollout(5)
    sent = env.transform.inv(seen[:, 0])["action"]
    leaning = (seen[:, 0]["observation"][..., 2] > 0).long()
    assert torch.equal(sent if categorical else sent.long().argmax(-1), leaning)
    assert sent.dtype == seen["action"].dtype


@pytest.mark.parametrize("make", [lambda: Takeover(0.5), lambda: JumpStart(4, random=True)])
def test_specs_hold_around_every_world(make):
    for env in worlds.everywhere(make):
        check_env(env.train())
