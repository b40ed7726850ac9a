"""Received run folders through the commands that read them."""

import shutil

import pytest
from drives import drive
from omegaconf import OmegaConf
from programs import TINY, called
from run_folders import make_untrained_run

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
