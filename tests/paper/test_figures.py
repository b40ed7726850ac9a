import os
import subprocess
import sys

import pytest
from programs import ROOT, environment


@pytest.mark.slow
def test_world_draws_the_world(tmp_path):
    command = [sys.executable, "-m", "coil_paper.figures.world", str(tmp_path)]
    done = subprocess.run(
        command, env=environment(ROOT), cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == str(tmp_path / "world.png")
    assert os.listdir(tmp_path) == ["world.png"]
