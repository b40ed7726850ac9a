"""Public controllers: equal to their originals, and as good as is known of them."""

import io
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from coil_rl import GymnasiumEnv
from coil_rl.guides import EntryGuide, classic
from coil_rl.guides.simple import FollowAdvice
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.transforms import GuideActions


def returns(id, guide, cases=4, **options):
    """Return the returns of a guide alone in seeded episodes."""
    env = GymnasiumEnv(id, cases, first_seed=0, cases=cases, **options)
    env = TransformedEnv(env, GuideActions({"guide": guide}))
    return [episode["reward"] for episode in evaluate_policy(env, FollowAdvice(env)).episodes]


def function(name, **options):
    return classic.ClassicGuide(name, options)


@pytest.mark.parametrize("continuous", [False, True])
def test_lander_is_the_heuristic_of_gymnasium(continuous):
    module = pytest.importorskip("gymnasium.envs.box2d.lunar_lander")
    env, generator = (
        gymnasium.make("LunarLander-v3", continuous=continuous),
        np.random.default_rng(0),
    )
    states = generator.normal(0, 0.5, (1000, 8)).astype(np.float32)
    states[:, 6:] = generator.integers(0, 2, (1000, 2)) * (generator.random((1000, 1)) < 0.3)
    expected = np.array([module.heuristic(env, state) for state in states])
    advice = classic.lander(torch.from_numpy(states), continuous).numpy()
    assert np.array_equal(advice, expected.astype(advice.dtype))
    assert len(np.unique(advice)) > 3  # all actions occur


@pytest.mark.slow
def test_energy_pump_climbs_and_a_brake_does_not():
    assert np.mean(returns("MountainCarContinuous-v0", function("energy_pump"))) == pytest.approx(
        89.4, abs=0.5
    )
    assert max(returns("MountainCarContinuous-v0", function("energy_pump", power=-1.0), 1)) < 0


def test_linear_feedback_balances_for_500_steps():
    assert returns("CartPole-v1", function("linear_feedback")) == [500.0] * 4


@pytest.mark.slow
def test_swing_up_ends_upright_from_anywhere():
    env = GymnasiumEnv("Pendulum-v1", 16, first_seed=0, cases=16)
    env = TransformedEnv(env, GuideActions({"guide": function("swing_up")}))
    after = env.rollout(200, FollowAdvice(env))[:, -1]["next"]
    assert (after["observation"][:, 0] > 0.999).all()


def test_oscillator_follows_its_sines_from_the_first_step_of_each_row():
    guide = classic.Oscillator(frequency=1.0, phases=(0.0, 0.25), amplitude=0.01)
    step = torch.tensor([[0], [25]])  # the second row: one turn later
    data = TensorDict({"observation": torch.zeros(2, 8), "swum_steps": step}, [2])
    after = guide(data)
    assert torch.allclose(after["action"], torch.tensor([[0.0, 0.1]]).expand(2, 2), atol=1e-5)
    assert after["next", "swum_steps"].tolist() == [[1], [26]]
    moving = data.clone().set(
        "observation", torch.tensor([0.0, 0.02, 0, 0, 0, 0, 0, 0.2]).expand(2, 8)
    )
    assert torch.allclose(
        guide(moving)["action"], torch.tensor([[-0.2, 0.0]]).expand(2, 2), atol=1e-5
    )


@pytest.mark.slow
@pytest.mark.parametrize(("frequency", "known"), [(0.62, 352), (0.3, 112)])
def test_oscillator_swims(frequency, known):
    pytest.importorskip("mujoco")
    assert np.mean(returns("Swimmer-v5", classic.Oscillator(frequency), 2)) == pytest.approx(
        known, abs=10
    )


def test_walker_keeps_one_state_a_row_and_continues_from_a_checkpoint():
    module = pytest.importorskip("gymnasium.envs.box2d.bipedal_walker")
    states = np.random.default_rng(0).normal(0, 0.2, (200, 24))
    states[:, [8, 13]] = np.arange(200)[:, None] % 40 > 30  # feet touch the ground
    walker, original, copy = classic.Walker(), module.BipedalWalkerHeuristics(), classic.Walker()
    seen = set()
    for index, state in enumerate(states):
        if index == 100:
            file = io.BytesIO()
            torch.save(walker.state_dict(), file)
            file.seek(0)
            copy.load_state_dict(torch.load(file, weights_only=True))
        action = walker.act(state.copy())
        assert np.array_equal(action, original.step_heuristic(state))
        if index >= 100:
            assert np.array_equal(copy.act(state.copy()), action)
        seen.add(walker.machine.state)
    assert seen == {1, 2, 3}
    walker.reset()
    assert np.array_equal(walker.act(states[0]), classic.Walker().act(states[0]))


def bot_env(**options):
    wrappers = [
        classic.LastAction,
        partial(pytest.importorskip("minigrid.wrappers").FlatObsWrapper),
    ]
    bot = {"bot": "coil_rl.guides.classic:Bot"}
    return {"wrappers": wrappers, "controllers": bot, **options}


def test_bot_ends_its_missions(capsys):
    rewards = returns("BabyAI-GoToLocal-v0", EntryGuide(["controller", "bot"]), 8, **bot_env())
    assert min(rewards) > 0.5
    assert not capsys.readouterr().out  # rejected levels are not printed


def test_bot_plans_again_after_actions_of_others():
    env = GymnasiumEnv("BabyAI-GoToLocal-v0", 8, seed=0, **bot_env(max_steps=200))
    carrier, ended, generator = env.reset(), 0, torch.Generator().manual_seed(0)
    for _ in range(150):
        others = torch.randint(7, (8,), generator=generator)
        takes = torch.rand(8, generator=generator) < 0.5
        action = torch.where(takes, others, carrier["controller", "bot"])
        step, carrier = env.step_and_maybe_reset(carrier.set("action", action))
        ended += int((step["next", "reward"] > 0).sum())
    assert ended > 20
