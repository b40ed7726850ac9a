"""YAML files of a package that is installed beside coil-rl."""

import subprocess
import sys

import pytest
from programs import ROOT, environment

SCRIPT = """
import coil_rl.config
from hydra import compose, initialize_config_dir
from coil_rl import compose_train
from coil_rl.config.trust import _shipped_targets

config = compose_train(["guide=wise", "run_dir=unused"])
assert config.guide.wise._target_ == "stranger.Wise", config.guide
assert "stranger.Wise" in _shipped_targets()
with initialize_config_dir("FOLDER", version_base="1.3"):
    # Where the group does not exist this is a value, and no choice of a file.
    assert dict(compose("own", ["+guide=wise"])) == {"a": 1, "guide": "wise"}
"""


@pytest.mark.slow
def test_files_of_an_installed_package_are_found_and_only_by_programs_of_coil_rl(tmp_path):
    package, info = tmp_path / "stranger" / "conf", tmp_path / "stranger-1.dist-info"
    (package / "guide").mkdir(parents=True)
    for folder in (package.parent, package):
        (folder / "__init__.py").write_text("")
    (package / "guide" / "wise.yaml").write_text("# @package guide.wise\n_target_: stranger.Wise\n")
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[coil_rl.conf]\nstranger = stranger.conf\n")
    (tmp_path / "own.yaml").write_text("a: 1\n")
    command = [sys.executable, "-c", SCRIPT.replace("FOLDER", str(tmp_path))]
    done = subprocess.run(
        command, cwd=ROOT, env=environment(tmp_path), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
