"""What a run folder says of an FMU: who may open it, and that it is the same one."""

from pathlib import Path

import fmus
import pytest
from omegaconf import OmegaConf

from coil_rl import UserError, compose_train
from coil_rl.config import nodes, parts, trust
from coil_rl.config.parts import build_pictures, env_maker
from coil_rl.report import Film


def config(file, *words):
    given = [f"env.file={file}", "env.step=0.01", "env.seconds=0.1", "env.workers=0"]
    given += ["env.setpoints={speed: 100}", "method=ppo", "run_dir=unused", "budget.num_envs=2"]
    composed = compose_train(["env=fmu", *given, *words])
    OmegaConf.resolve(composed)
    return composed


@pytest.fixture(autouse=True)
def forget():
    yield
    trust.trust_packages([])


def test_a_received_folder_runs_no_fmu_without_trust():
    received = config(fmus.motor(), "logger=none")
    with pytest.raises(UserError, match=r"env._target_ names .* trust=\[coil_fmu\]"):
        trust.check_config(received, Path("config.yaml"))
    trust.trust_packages(["coil_fmu"])
    trust.check_config(received, Path("config.yaml"))
    received.env.reward = "os:system"
    with pytest.raises(UserError, match=r"env\.reward names 'os\.system'"):
        trust.check_config(received, Path("config.yaml"))


def test_another_fmu_of_that_name_is_seen(tmp_path):
    other = fmus.edited(fmus.motor(), tmp_path / "motor.fmu", {"of the armature": "of it"})
    one, two = (nodes.code_of_run(config(path)) for path in (fmus.motor(), other))
    assert one.keys() == two.keys() == {"motor.fmu"}
    assert one != two


def test_an_agent_may_observe_all_that_the_env_writes():
    composed = config(fmus.motor())
    env = env_maker(composed).bare(2, "test", None)
    keys = parts.observed_keys(composed, env)
    assert keys == ["current", "speed", "speed_setpoint"]


def test_a_film_of_an_fmu_is_made_only_where_it_is_asked_for(tmp_path, capsys):
    for words, said in ((), ""), (["evaluation.gif=true"], "not drawn: the env gives no pictures"):
        composed = config(fmus.motor(), *words)
        [film] = [each for each in build_pictures(composed) if isinstance(each, Film)]
        film.watch(env_maker(composed).bare(2, "test", None), {"ppo": 0}, None, None)
        film.draw({}, tmp_path)
        assert said in capsys.readouterr().err
        assert film.watches == bool(said)
