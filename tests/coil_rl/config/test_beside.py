"""Controllers beside an env act only where something reads what they would do."""

import pytest
from hydra import compose, initialize_config_module
from torchrl.envs import RenameTransform

from coil_rl.config.parts import env_maker, unread_controllers
from coil_rl.run.parts import TEST

pytest.importorskip("gymnasium.envs.classic_control")


def push(env, observation):
    """Push a cart where its pole leans to."""
    return int(observation[2] > 0)


BESIDE = [
    "env=cart_pole",
    *(
        f"+env.controllers.{name}={{_target_: {__name__}.push, _partial_: true}}"
        for name in ("leaning", "other")
    ),
    "guide=entry",
    "guide.entry.key=[controller,leaning]",
    "run_dir=unused",
]


def composed(*overrides):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose("train", [*BESIDE, *overrides])


def beside(env):
    return list(env.base_env.held.plants[0].controllers)


def test_agent_without_a_guide_has_no_controllers():
    assert beside(env_maker(composed("method=ppo"))(2)) == []


def test_agent_with_a_guide_has_the_one_that_its_guide_reads():
    for method in ("coil", "coil_rfc", "kickstart"):
        assert beside(env_maker(composed(f"method={method}"))(2)) == ["leaning"]


def test_guide_alone_has_its_controllers_whatever_the_method():
    env, _ = env_maker(composed("method=ppo")).guided(2, TEST)
    assert "leaning" in beside(env)


@pytest.mark.parametrize(
    "reader",
    [
        "observes=[observation,[controller,other]]",
        "+watch.step.other=[controller,other]",
        "evaluation.measures.completed.entry=[controller,other]",
    ],
)
def test_controller_that_is_observed_logged_or_measured_stays(reader):
    assert beside(env_maker(composed("method=ppo", reader))(2)) == ["other"]


def test_controller_that_a_transform_reads_stays():
    transform = RenameTransform([("controller", "leaning")], ["leaning"])
    assert unread_controllers(composed("method=ppo"), [transform]) == {"other"}


def test_name_inside_of_another_word_is_no_reader():
    config = composed("method=ppo", "label=others", "observes=[observation,leaning_more]")
    assert unread_controllers(config, []) == {"leaning", "other"}
