import pytest

from coil_rl.config.compose import compose_train


@pytest.mark.fast(4)
@pytest.mark.parametrize(
    ("words", "method"),
    [
        ([], "coil"),
        (["env=cone_track_paper"], "coil"),
        (["env=simulated_robot"], "coil"),
        (["env=gym", "env.id=Pendulum-v1"], "ppo"),
        (["env=gym", "env.id=Pendulum-v1", "guide=random"], "coil_anchored"),
        (["env=gym", "env.id=Pendulum-v1", "guide=[random,zero]"], "coil_anchored"),
        (["env=pendulum"], "coil_anchored"),
        (["env=pendulum", "method=rfc"], "rfc"),
        (["env=pendulum", "+experiment=placebo"], "coil"),
    ],
)
def test_a_run_that_names_no_method_holds_the_guide_of_a_foreign_env(
    words: list[str], method: str
) -> None:
    assert compose_train(words).method.name == method
