from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from coil_rl.train.fingerprint import fingerprint


def composed(*overrides):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose("train", list(overrides))


def test_only_what_changes_the_numbers_of_a_run_changes_its_fingerprint():
    one = fingerprint(composed())
    assert one == fingerprint(composed("run_dir=elsewhere", "logger=none", "existing=resume"))
    others = [("seed=1",), ("learner.gamma=0.98",), ("method=ppo",), ("track.train.split=test",), ("label=mine",)]
    assert len({one, *(fingerprint(composed(*other)) for other in others)}) == 1 + len(others)


def test_a_configuration_and_what_a_run_keeps_of_it_have_one_fingerprint():
    config = composed("run_dir=here")
    assert fingerprint(OmegaConf.create(OmegaConf.to_container(config, resolve=True))) == fingerprint(config)


def test_a_run_of_a_sweep_can_have_it_in_the_name_of_its_folder():
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        config = compose(
            "train", ["seed=3", "hydra.sweep.subdir=${label}_seed${seed}_${fingerprint:}"], return_hydra_config=True
        )
    assert config.hydra.sweep.subdir == f"coil_seed3_{fingerprint(composed('seed=3'))}"
