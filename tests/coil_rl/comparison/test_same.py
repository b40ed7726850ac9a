"""A folder goes on with the same comparison only."""

import pytest
from odd_parts import Gain

from coil_rl.comparison.same import identity_of, keep_plan, known_plan
from coil_rl.comparison.timing import Plan
from coil_rl.config import nodes
from coil_rl.config.python import Named, composed, named
from coil_rl.errors import UserError

PLAN = Plan(frames={"ppo": 128}, cases=5, seeds=2, seconds=1.0)


def identity(folder, *words, guide="swing_up", env="pendulum"):
    given = named(env, guide, str(folder))
    given = Named([*given.words, *words], given.nodes)
    config = composed(Named([*given.words, "method=ppo"], given.nodes), folder / "ppo").config
    return identity_of(given, config, 2.0, 0)


def test_same_object_goes_on_in_a_folder_that_was_moved(tmp_path):
    keep_plan(tmp_path, identity(tmp_path / "one", guide=Gain(1.0)), PLAN)
    assert known_plan(tmp_path, identity(tmp_path / "two", guide=Gain(1.0))) == PLAN


def test_other_object_is_refused(tmp_path):
    keep_plan(tmp_path, identity(tmp_path, guide=Gain(1.0)), PLAN)
    other = identity(tmp_path, guide=Gain(-1.0))
    with pytest.raises(UserError, match=r"a comparison with guide\.controller\.of=.*Gain \(state"):
        known_plan(tmp_path, other)


@pytest.mark.slow
def test_changed_file_of_the_user_is_refused_by_the_value_that_differs(tmp_path):
    file = tmp_path / "conf" / "experiment" / "mine.yaml"
    file.parent.mkdir(parents=True)
    words = [f"hydra.searchpath=['file://{tmp_path / 'conf'}']", "+experiment=mine"]
    file.write_text("# @package _global_\nlearner: {gamma: 0.9}\nenv: {workers: 1}\n")
    keep_plan(tmp_path, identity(tmp_path, *words), PLAN)
    file.write_text("# @package _global_\nlearner: {gamma: 0.9}\nenv: {workers: 2}\n")
    assert known_plan(tmp_path, identity(tmp_path, *words)) == PLAN
    file.write_text("# @package _global_\nlearner: {gamma: 0.8}\nenv: {workers: 2}\n")
    with pytest.raises(UserError, match=r"learner\.gamma=0\.9, not 0\.8; give the same arguments"):
        known_plan(tmp_path, identity(tmp_path, *words))


def test_changed_code_of_env_or_guide_is_refused(tmp_path, monkeypatch):
    keep_plan(tmp_path, identity(tmp_path), PLAN)
    monkeypatch.setattr(nodes, "code_of_run", lambda config: {"mine": "a hash of its file"})
    with pytest.raises(UserError, match="holds a comparison with code of env and guide="):
        known_plan(tmp_path, identity(tmp_path))
