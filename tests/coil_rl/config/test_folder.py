"""Shipped policies: small, checked before they are read, and wherever a run is read."""

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hydra.utils import get_object
from programs import called
from tiny_runs import trained

import coil_rl
from coil_rl.config import folder as folders
from coil_rl.config.folder import CARD, CHECKSUMS, LARGEST, OLD_NAMES, renamed
from coil_rl.errors import UserError
from coil_rl.run.experiment import INIT

PLACE = Path(folders.__file__).parents[1] / "policies"
NAMES = coil_rl.pretrained_names()


@pytest.mark.parametrize("name", NAMES)
def test_shipped_policy_names_no_place_and_has_a_card(name):
    settings = yaml.safe_load((PLACE / name / "config.yaml").read_text())
    assert settings["run_dir"] == "pretrained"
    card = coil_rl.pretrained_card(name)
    frames, seed = settings["budget"]["frames"], settings["seed"]
    for text in (f"# {name}", f"{frames:,} frames", f"Its seed is {seed}", "torch ", "sampled"):
        assert text in card
    assert "/tmp" not in card


def test_controller_of_a_shipped_policy_acts():
    controller = coil_rl.pretrained("pendulum/coil").controller()
    action = controller.act(np.array([1.0, 0.0, 0.5], np.float32))
    assert action.shape == (1,)
    assert -2 <= action[0] <= 2


def test_unknown_name_lists_the_known_ones():
    message = "cone_track/coin does not exist; there are .*; did you mean cone_track/coil"
    with pytest.raises(UserError, match=message):
        coil_rl.pretrained("cone_track/coin")


@pytest.mark.parametrize("file", ["policy_last.pt", "config.yaml", CARD])
def test_changed_file_is_refused_before_it_is_read(file, tmp_path, monkeypatch):
    name = "cone_track/ppo"
    shutil.copytree(PLACE, tmp_path / "policies")
    monkeypatch.setattr(folders, "_place", lambda: tmp_path / "policies")
    path = tmp_path / "policies" / name / file
    path.write_bytes(path.read_bytes() + b"\n")
    refused = partial(pytest.raises, UserError, match=f"{file} is not the file that was shipped")
    with refused():
        coil_rl.pretrained(name)
    path.unlink()
    with refused():
        coil_rl.pretrained(name)


def test_every_file_has_a_checksum_and_the_files_of_a_policy_are_small():
    known = json.loads((PLACE / CHECKSUMS).read_text())
    for name in NAMES:
        files = list((PLACE / name).iterdir())
        assert sorted(known[name]) == sorted(file.name for file in files)
        assert sum(file.stat().st_size for file in files) < LARGEST


@pytest.mark.slow
def test_program_takes_a_shipped_policy(tmp_path):
    words = ["evaluation.repeats=1", "evaluation.cases=2", f"hydra.run.dir={tmp_path / 'results'}"]
    done = called("evaluate", "run=pretrained:pendulum/coil", *words)
    assert "coil: mean test reward" in done.stdout


def test_shipped_policy_is_a_guide():
    guide = coil_rl.LearnedGuide("pretrained:pendulum/coil")
    env = coil_rl.GymnasiumEnv("Pendulum-v1", num_envs=2)
    assert guide(env.reset())["action"].shape == (2, 1)


@pytest.mark.slow
def test_shipped_policy_is_the_first_one_of_a_run(tmp_path):
    folder = trained(tmp_path / "run", "ppo", "init=pretrained:cone_track/ppo")
    first = torch.load(folder / "policies" / "000000000000.pt", weights_only=True)
    shipped = torch.load(folder / INIT, weights_only=True)
    assert all(torch.equal(value, shipped[name]) for name, value in first.items())
    said = "It began with the policy of pretrained:cone_track/ppo, whose frames are not among"
    assert said in (folder / "evaluation.md").read_text()


@pytest.mark.parametrize(
    ("name", "argument", "message"),
    [
        ("train", "resume=", "has no training that could go on; begin a run with it by init=pre"),
        ("report", "folder=", "evaluate a shipped policy by coil-evaluate run=pretrained:cone_t"),
    ],
)
def test_program_says_what_a_shipped_policy_is_not_for(name, argument, message, tmp_path):
    said = called(name, f"{argument}pretrained:cone_track/ppo", cwd=tmp_path, code=2)
    assert message in said.stderr


def test_parts_that_moved_are_found_at_any_depth():
    assert all(map(get_object, OLD_NAMES.values()))
    for old, new in OLD_NAMES.items():
        node = {"guide": {"one": {"_target_": old}}, "list": [{"_target_": old, "of": 3}]}
        found = {"guide": {"one": {"_target_": new}}, "list": [{"_target_": new, "of": 3}]}
        assert renamed(node) == found
