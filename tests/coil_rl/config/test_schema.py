import pytest
from omegaconf import OmegaConf
from programs import composed

from coil_rl.config.compose import compose_train
from coil_rl.config.schema import fingerprint

NOISE = "training.noise_correlation"


@pytest.mark.fast(12)
@pytest.mark.parametrize(
    ("words", "key", "value"),
    [
        # the method and an unusual learner
        ("", "label", "coil"),
        ("method=ppo", "label", "ppo"),
        ("method=ppo learner=a2c", "label", "a2c"),
        ("method=coil learner=trpo", "label", "coil_trpo"),
        ("learner._target_=others.Q", "label", "coil_q"),
        ("method=oil learner=linear", "label", "oil"),
        ("method=dynamic_coil_stochastic", "label", "dynamic_coil_stochastic"),
        ("method=ppo learner=a2c label=mine", "label", "mine"),
        ("method=ibrl label=${agent_label:}", "label", "ibrl"),
        # that of a foreign env holds its guide
        ("", "method.name", "coil"),
        ("env=cone_track_paper", "method.name", "coil"),
        ("env=simulated_robot", "method.name", "coil"),
        ("env=gym env.id=Pendulum-v1", "method.name", "ppo"),
        ("env=gym env.id=Pendulum-v1 guide=random", "method.name", "coil_anchored"),
        ("env=gym env.id=Pendulum-v1 guide=[random,zero]", "method.name", "coil_anchored"),
        ("env=pendulum", "method.name", "coil_anchored"),
        ("env=pendulum method=rfc", "method.name", "rfc"),
        ("env=pendulum +experiment=placebo", "method.name", "coil"),
        # the same for all methods
        ("method=ppo", "learner.learning_rate.start", 1e-3),
        ("method=coil", "learner.learning_rate.start", 1e-3),
        ("method=coil_anchored", "learner.learning_rate.start", 1e-3),
        # of the world
        ("method=coil", NOISE, 0.7),
        ("method=coil_anchored", NOISE, 0.7),
        ("method=coil preset=paper", NOISE, 0.0),
        ("method=coil preset=authors", NOISE, 0.0),
        ("method=coil_anchored preset=authors", NOISE, 0.0),
        (f"method=coil_anchored preset=authors {NOISE}=0.5", NOISE, 0.5),
        ("method=ppo env=driving_tasks", NOISE, 0.0),
        ("method=ppo env=lunar_lander", NOISE, 0.0),
        ("env=cone_track", "learner.normalise", False),
        ("env=driving_tasks", "learner.normalise", False),
        ("env=simulated_robot", "learner.normalise", False),
        ("env=lunar_lander method=ppo", "learner.normalise", "auto"),
        ("env=cart_pole method=ppo", "learner.normalise", "auto"),
        ("env=babyai method=ppo", "learner.normalise", "auto"),
        # of the learner
        ("learner=dqn", "action.choices", 5),
        *((f"learner={name}", "action", {}) for name in ("sac", "ppo")),
        *((f"learner={name}", "budget.num_envs", 8) for name in ("dqn", "sac")),
        *((f"learner={name}", "budget.steps", 4) for name in ("dqn", "sac")),
        ("learner=ppo", "budget.num_envs", 256),
        ("learner=ppo", "budget.steps", 24),
        *((f"learner={name}", "budget.frames", 200_000) for name in ("dqn", "sac", "ppo")),
    ],
)
def test_what_nobody_gives_follows_from_what_is_given(words, key, value):
    config = compose_train([*words.split(), "run_dir=unused"])
    assert OmegaConf.select(config, key) == value


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
