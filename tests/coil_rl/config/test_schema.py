import pytest
from omegaconf import OmegaConf
from programs import composed

from coil_rl.config.compose import compose_train
from coil_rl.config.schema import fingerprint


@pytest.mark.fast(4)
@pytest.mark.parametrize(
    ("overrides", "label"),
    [
        ("", "coil"),
        ("method=ppo", "ppo"),
        ("method=ppo learner=a2c", "a2c"),
        ("method=coil learner=trpo", "coil_trpo"),
        ("learner._target_=others.Q", "coil_q"),
        ("method=oil learner=linear", "oil"),
        ("method=dynamic_coil_stochastic", "dynamic_coil_stochastic"),
        ("method=ppo learner=a2c label=mine", "mine"),
        ("method=ibrl label=${agent_label:}", "ibrl"),
    ],
)
def test_label_is_the_method_and_an_unusual_learner(overrides, label):
    assert composed(*overrides.split(), "run_dir=unused").label == label


@pytest.mark.parametrize("method", ["ppo", "coil", "coil_anchored"])
def test_learning_rate_is_the_same_for_all_methods(method):
    learner = composed(f"method={method}", "run_dir=unused").learner
    assert learner.learning_rate.start == 1e-3


@pytest.mark.fast(4)
@pytest.mark.parametrize(
    ("overrides", "correlation"),
    [
        ("method=coil", 0.7),
        ("method=coil_anchored", 0.7),
        ("method=coil preset=paper", 0.0),
        ("method=coil preset=authors", 0.0),
        ("method=coil_anchored preset=authors", 0.0),
        ("method=coil_anchored preset=authors training.noise_correlation=0.5", 0.5),
        ("method=ppo env=driving_tasks", 0.0),
        ("method=ppo env=lunar_lander", 0.0),
    ],
)
def test_correlation_of_the_noise_is_that_of_the_world(overrides, correlation):
    assert composed(*overrides.split(), "run_dir=unused").training.noise_correlation == correlation


def test_fingerprint_depends_on_everything_that_changes_the_numbers():
    one = fingerprint(composed())
    assert one == fingerprint(composed("run_dir=elsewhere", "logger=none", "existing=resume"))
    others = [
        ("seed=1",),
        ("learner.gamma=0.98",),
        ("method=ppo",),
        ("track.train.split=test",),
        ("label=mine",),
    ]
    assert len({one, *(fingerprint(composed(*other)) for other in others)}) == 1 + len(others)


def test_saved_configuration_has_the_same_fingerprint():
    config = composed("run_dir=here")
    assert fingerprint(
        OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    ) == fingerprint(config)


def test_fingerprint_in_the_name_of_a_sweep_folder():
    subdir = "hydra.sweep.subdir=${label}_seed${seed}_${fingerprint:}"
    config = composed("seed=3", subdir, return_hydra_config=True)
    assert config.hydra.sweep.subdir == f"coil_seed3_{fingerprint(composed('seed=3'))}"


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
