from itertools import product

import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf
from programs import shipped

from coil_rl.config.nodes import build
from coil_rl.config.parts import (
    build_bare_env,
    build_guides,
    build_learner,
    build_transforms,
    cases_node,
    disturbances,
    env_maker,
    trains_guides,
)
from coil_rl.config.proxies import guides_with_untrained_proxies
from coil_rl.errors import UserError
from coil_rl.run.parts import TEST, TESTS, TRAIN
from coil_rl.testing import check_env, check_guide
from coil_rl.transforms import ActionDelay, GuideActions, ObservationDelay

SMALL = [
    "track=generated",
    "track.train.count=1",
    "track.test.count=1",
    "budget.num_envs=4",
    "run_dir=unused",
]


def composed(*overrides, name="train"):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose(name, [*SMALL, *overrides])


@pytest.mark.fast(1)
@pytest.mark.parametrize(("method", "preset"), [*product(shipped("method"), shipped("preset"))])
def test_env_of_every_method_passes_check_env(method, preset):
    env = env_maker(composed(f"preset={preset}", f"method={method}"))()
    check_env(env, steps=3)
    assert env.rate == {"default": 12, "paper": 24, "authors": 60}[preset]


NOT_ALONE = {
    "cone_planner",
    "controller",
    "entry",
    "exported",
    "learned",
    "pid",
    "recorded",
    "recording",
}  # need a package, a class, an entry, a run, an entry to control, a file or recordings
WITH_MEMORY = {"authors", "spline_memory"}
OF_OTHER_ENVS = {
    "bot",
    "energy_pump",
    "lander",
    "linear_feedback",
    "oscillator",
    "swing_tip",
    "swing_up",
    "walker",
}


@pytest.mark.fast(3)
@pytest.mark.parametrize(
    "guide", sorted({*shipped("guide")} - {"none", *NOT_ALONE, *OF_OTHER_ENVS})
)
def test_every_guide_acts_on_the_observations_of_the_env(guide):
    config = composed(f"guide={guide}")
    (guide_module,), env = build_guides(config).values(), build_bare_env(config)
    if guide in WITH_MEMORY:
        check_guide(guide_module, env)
        return
    data = env.reset()
    assert guide_module(data.copy())["action"].shape == (4, 1)
    if guide != "random":
        check_guide(guide_module, data)


def test_override_with_another_target_replaces_all_arguments():
    config = composed("env=simulated_robot")
    tracks = {"_target_": "coil_rl.envs.robot_tracks", "scale": 1.0}
    env = build_bare_env(config, {"tracks": tracks, "reward": {"finish": 1.0}, "num_envs": 2})
    assert (env.batch_size, config.budget.num_envs) == ((2,), 4)
    assert [track.name for track in env.tracks] == ["robot (simulated)"]
    assert env.weights["finish"] == 1
    assert env.weights["crash"] == -100


def lists_its_arguments(**options):
    raise TypeError(f"unexpected {options}")


@pytest.mark.slow
def test_long_message_of_a_part_is_cut():
    node = {"_target_": f"{__name__}.lists_its_arguments", "numbers": list(range(9999))}
    with pytest.raises(
        UserError, match=r"^env: unexpected {'numbers': \[0, 1, 2,[ 0-9,]{300,500} \.\.\.$"
    ):
        build(node, "env")


def test_guide_drives_with_degraded_advice():
    config = composed("guide=constant", "guide.constant.value=0.4", "degrade=[undertuned,biased]")
    env, policy = env_maker(config).guided(4, TRAIN)
    step = env.step(policy(env.reset()))
    torch.testing.assert_close(step["next", "steering"], torch.full((4, 1), 0.4 * 0.5 + 0.2))


def test_advice_of_a_method_without_any_is_not_degraded():
    view = "{_target_: coil_rl.transforms.ObservationNoise, sigma: 0.1, seed: 0}"
    config = composed(
        "method=ppo", f"+method.transforms.view={view}", "degrade=[random]", "run_dir=unused"
    )
    transforms = build_transforms(config)
    assert [type(part).__name__ for part in transforms] == ["ObservationNoise"]
    env_maker(config)().rollout(2)


def test_advice_is_degraded_after_the_transforms_of_the_method():
    config = composed(
        "method=residual", "guide=constant", "guide.constant.value=0.4", "degrade=[zeroed]"
    )
    env = env_maker(config)()
    step = env.step(env.reset().set("action", torch.full((4, 1), 0.5)))
    torch.testing.assert_close(step["next", "steering"], torch.full((4, 1), 0.25))


@pytest.mark.fast(2)
@pytest.mark.parametrize("learner", shipped("learner"))
def test_every_learner_is_built(learner):
    config = composed(f"learner={learner}")
    env = env_maker(config)()
    built = build_learner(
        config, env, guides_with_untrained_proxies(config) if trains_guides(config) else None
    )
    assert built.policy(env.reset())["action"].shape == env.action_spec.shape


@pytest.mark.slow
@pytest.mark.parametrize("track", sorted({*shipped("track")} - {"folder"}))
def test_every_track_group_has_tracks(track):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        node = compose("train", [f"track={track}", "run_dir=unused"]).track
    fewest = 1 if track == "robot" else 3
    assert min(len(build(node.train, "track.train")), len(build(node.test, "track.test"))) >= fewest


@pytest.mark.parametrize(
    ("env", "key"), [("cone_track", "starts"), ("simulated_robot", "starts"), ("pendulum", "cases")]
)
def test_cases_of_several_drivers_are_the_same_ones(env, key):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        evaluation = compose("train", [f"env={env}", "run_dir=unused"]).evaluation
    # In the file of a run all references are resolved.
    stored = OmegaConf.create({"evaluation": OmegaConf.to_container(evaluation, resolve=True)})
    node = cases_node(stored, 6, "selection", 3)
    assert (node[key], node["num_envs"]) == (3, 6)


def test_disturbances_hold_in_training_and_evaluation_unless_one_of_them_has_its_own():
    both = composed("disturb=[observation_delay]")
    assert disturbances(both, TRAIN) == disturbances(both, TEST)
    longer = composed(
        "disturb=[observation_delay,action_delay]",
        "+evaluation.disturb.observation_delay.max_lag=7",
        "+training.disturb.action_delay=null",
    )
    lags = {
        cases: {name: node["max_lag"] for name, node in disturbances(longer, cases).items()}
        for cases in (TRAIN, TESTS, TEST, "evaluation")
    }
    assert lags[TRAIN] == lags[TESTS] == {"observation_delay": 2}
    assert lags[TEST] == lags["evaluation"] == {"observation_delay": 7, "action_delay": 2}


def test_disturbances_come_before_the_guides_and_only_in_the_own_env_of_a_run():
    config = composed("disturb=[observation_delay,action_delay]", "method=coil")
    make_env = env_maker(config)
    for env in (make_env(), make_env.guided(2, TEST)[0]):
        kinds = [type(part) for part in env.transform]
        assert kinds.index(ObservationDelay) < kinds.index(ActionDelay) < kinds.index(GuideActions)
    around = make_env.around(build_bare_env(config))
    assert ObservationDelay not in [type(part) for part in around.transform]


def test_the_authors_observe_late_in_their_world_and_nowhere_else():
    assert disturbances(composed("preset=authors"), TRAIN)["late"]["min_lag"] == 1
    assert not disturbances(composed("env=simulated_robot", "preset=authors"), TRAIN)


def test_the_view_of_the_agent_alone_is_late_behind_the_guides():
    config = composed("+disturb@method.transforms.view=observation_delay", "method=coil")
    kinds = [type(part) for part in env_maker(config)().transform]
    assert kinds.index(GuideActions) < kinds.index(ObservationDelay)
