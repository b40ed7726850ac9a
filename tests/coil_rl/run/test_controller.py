"""What a machine is sent is what an evaluation executes, for every method."""

import copy

import numpy as np
import pytest
import torch
from any_env import AnyEnv
from learned_runs import ON_POLICY, OPTIONS, STEPS, TINY, learned
from programs import shipped
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Unbounded
from torchrl.envs import Compose, ExplorationType, TransformedEnv, set_exploration_type

import coil_rl
from coil_rl.run.controller import Controller
from coil_rl.run.parts import TEST

# A search of numbers trains no policy.
METHODS = sorted({*shipped("method")} - {"tune"})
# Learners that refuse a network with a memory.
WITHOUT_MEMORY = {*OPTIONS, "advisor"} - {"coil_anchored", "guide"}
WITHOUT_MEMORY |= {method for method in METHODS if method.startswith("dynamic_coil")}


pytestmark = pytest.mark.usefixtures("thermostat")


def executed(run):
    """Return observations of the plant and what it was given, in an episode of an evaluation."""
    if run.make_learner is None:
        env, policy = run.make_env.guided(1, TEST)
    else:
        env = run.make_env(1, TEST)
        policy = run.policy(env)
    plant, observations, actions = env.eval().base_env, [], []
    carrier = env.reset()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(STEPS):
            observations.append(plant.held.plants[0].observation)
            _, carrier = env.step_and_maybe_reset(policy(carrier))
            actions.append(plant.decode(torch.from_numpy(plant.actions[-1])))
    return observations, actions


def check_same(folder):
    observations, actions = executed(coil_rl.open_run(folder))
    controller = coil_rl.open_run(folder).controller()
    for _ in range(2):
        controller.reset()
        sent = [controller.act(observation) for observation in observations]
        np.testing.assert_allclose(sent, actions, rtol=0, atol=1e-6)
    controller.reset()
    begun = [controller.act(observation) for observation in observations[:2]]
    of_another_row = copy.deepcopy(controller)
    begun_there = [of_another_row.act(observation) for observation in observations[:2]]
    np.testing.assert_allclose([begun, begun_there], [actions[:2]] * 2, rtol=0, atol=1e-6)
    np.testing.assert_allclose(controller.act(observations[2]), actions[2], rtol=0, atol=1e-6)
    return observations, actions, controller


@pytest.mark.fast("coil_anchored")
@pytest.mark.parametrize("method", METHODS)
def test_controller_acts_as_the_policy_does_in_an_evaluation(method, tmp_path):
    _, actions, _ = check_same(learned(tmp_path / "run", method))
    assert np.ptp(actions) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("method", sorted({*METHODS} - WITHOUT_MEMORY - {"guide"}))
def test_controller_has_the_memory_of_its_policy(method, tmp_path):
    observations, actions, controller = check_same(
        learned(tmp_path / "run", method, "network=gru", "learner.minibatches=1")
    )
    controller.reset()
    for observation in observations[:7]:
        controller.act(observation)
    other = coil_rl.open_run(tmp_path / "run").controller()
    other.load_state_dict(controller.state_dict())
    np.testing.assert_allclose(other.act(observations[7]), actions[7], rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("options", [["learner.normalise=true"], ["degrade=[delayed]"]])
def test_controller_has_normaliser_and_degraded_advice_inside(options, tmp_path):
    check_same(learned(tmp_path / "run", "coil", *options))


@pytest.mark.slow
def test_env_with_several_rows_is_refused(tmp_path):
    run = coil_rl.open_run(learned(tmp_path / "run", "ppo"))
    env = run.make_env(2)
    with pytest.raises(ValueError, match=r"a controller needs an env of one row, not \[2\]"):
        Controller(env, run.policy(env))


@pytest.mark.slow
def test_cone_world_is_sent_its_steering(tmp_path):
    folder = tmp_path / "run"
    small = [word for word in TINY if not word.startswith(("env.", "evaluation.cases"))]
    small += [*ON_POLICY, "track=generated", "track.train.count=1", "track.test.count=1"]
    options = {"method": "residual", "frames": 32, "folder": folder, "overrides": small}
    run = coil_rl.prepare("cone_track", guide="spline", **options)
    run.begin()
    run.learn()
    env = run.make_env(1, TEST)
    policy, controller = run.policy(env), run.controller()
    carrier, read = env.eval().reset(), list(env.base_env.observation_spec.keys())
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(STEPS):
            observation = carrier.select(*read)[0]
            step, carrier = env.step_and_maybe_reset(policy(carrier))
            sent = torch.as_tensor(controller.act(observation))
            torch.testing.assert_close(sent, step["next", "executed_action"][0], rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="cones is missing, which the policy or its guide reads"):
        controller.act(observation.exclude("cones"))
    with pytest.raises(ValueError, match="observation holds a number that is not finite"):
        controller.act(observation.clone().set("observation", observation["observation"] / 0))


def doubling():
    """Return a controller that acts twice the level, which is inside of another entry."""
    policy = TensorDictModule(lambda level: 2 * level, [("tank", "level")], ["action"])
    env = AnyEnv(1, Bounded(-10, 10, (1,)), {("tank", "level"): Unbounded((1,))})
    return Controller(TransformedEnv(env, Compose()), policy)


@pytest.mark.parametrize(
    "observation",
    [
        [3.0],
        {("tank", "level"): [3.0]},
        {"tank": {"level": [3.0]}, "other": {"level": [4.0]}},
        TensorDict({"tank": {"level": torch.tensor([3.0])}}),
    ],
    ids=["alone", "flat", "nested", "tensordict"],
)
def test_observation_inside_of_an_entry_is_given_in_any_form(observation):
    assert doubling().act(observation).tolist() == [6.0]


def test_missing_observation_inside_of_an_entry_is_named():
    with pytest.raises(ValueError, match=r"'level'.* is missing, which the policy or its guide"):
        doubling().act({"tank": {"pressure": [3.0]}})
