"""Received run folders through the commands that read them."""

import shutil

import pytest
from drives import drive
from omegaconf import OmegaConf
from programs import TINY, called
from run_folders import make_untrained_run

from coil_rl.config import trust

COMMANDS = {
    "evaluate": ["run=run", "track=generated", "track.test.count=1"],
    "listen": ["run=run"],
    "replay": ["recording=drive.mcap", "runs=[run]", "guide=[]"],
    "train": ["resume=run"],
    "train learned": [*TINY, "guide=learned", "guide.learned.run=run", "hydra.run.dir=new"],
}


@pytest.fixture(scope="module")
def received(tmp_path_factory):
    """Make a folder with the run of a toy agent and a recorded drive."""
    folder = tmp_path_factory.mktemp("received")
    make_untrained_run(folder / "run", *TINY, "method=coil")
    drive(folder / "drive.mcap", 6)
    return folder


def with_guide(run, target):
    config = OmegaConf.load(run / "config.yaml")
    config.guide = config.method.transforms.advice.guides = {"theirs": target}
    OmegaConf.save(config, run / "config.yaml")


@pytest.mark.fast(2)
@pytest.mark.parametrize("command", COMMANDS)
def test_command_runs_no_code_from_a_folder(command, received, tmp_path):
    shutil.copytree(received, tmp_path, dirs_exist_ok=True)
    config = OmegaConf.load(tmp_path / "run" / "config.yaml")
    config.method.transforms.x = {
        "_target_": "builtins.open",
        "file": str(tmp_path / "marker"),
        "mode": "w",
    }
    OmegaConf.save(config, tmp_path / "run" / "config.yaml")
    stderr = called(command.split()[0], *COMMANDS[command], cwd=tmp_path, code=2).stderr
    sentence = stderr.splitlines()[-1]
    assert (
        "run/config.yaml: method.transforms.x._target_ names 'builtins.open', "
        "which is no part of a run" in sentence
    )
    assert "Traceback" not in stderr
    assert not (tmp_path / "marker").exists()
    assert {path.name for path in tmp_path.iterdir()} <= {"run", "drive.mcap", "outputs"}


@pytest.mark.slow
def test_outside_part_of_a_run_needs_trust_on_the_command_line(received, tmp_path, monkeypatch):
    shutil.copytree(received, tmp_path, dirs_exist_ok=True)
    (tmp_path / "neighbours_package.py").write_text(
        "from pathlib import Path\nfrom coil_rl.guides import ZeroGuide\n\n"
        "class TheirGuide(ZeroGuide):\n    def __init__(self):\n        super().__init__()\n"
        "        Path('marker').touch()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with_guide(tmp_path / "run", {"_target_": "neighbours_package.TheirGuide"})
    refused = called("evaluate", "run=run", cwd=tmp_path, code=2).stderr
    assert "allow it with trust=[neighbours_package] on the command line" in refused
    assert not (tmp_path / "marker").exists()
    small = [
        "track=generated",
        "track.test.count=1",
        "evaluation.repeats=1",
        "trust=[neighbours_package]",
    ]
    called("evaluate", "run=run", *small, cwd=tmp_path)
    assert (tmp_path / "marker").exists()
    assert "allow it with trust" in called("train", "resume=run", cwd=tmp_path, code=2).stderr
    assert (
        "functions of os run any code"
        in called("train", "resume=run", "trust=[os]", cwd=tmp_path, code=2).stderr
    )
    trust.trust_packages([])
