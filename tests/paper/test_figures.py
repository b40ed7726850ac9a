import os
import subprocess
import sys

import pytest
from programs import LAP, ROOT, environment
from run_folders import make_untrained_run


def run(script, *arguments, code=0):
    command = [sys.executable, "-m", f"coil_paper.figures.{script}", *map(str, arguments)]
    done = subprocess.run(
        command, env=environment(ROOT), cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == code, done.stderr
    return done.stderr if code else done.stdout


@pytest.mark.slow
def test_world_draws_the_world(tmp_path):
    assert run("world", tmp_path).splitlines()[-1] == str(tmp_path / "world.png")
    assert os.listdir(tmp_path) == ["world.png"]


@pytest.mark.slow
def test_lines_draws_the_agents_of_runs_and_the_guide(tmp_path):
    runs = [
        make_untrained_run(tmp_path / label, f"method={label}", *LAP) for label in ("ppo", "coil")
    ]
    rows = [
        line.split("|")[1].strip()
        for line in run("lines", *runs, "--output", tmp_path).splitlines()[2:-1]
    ]
    assert rows == ["guide", "ppo", "coil"]
    assert (tmp_path / "lines.png").exists()


@pytest.mark.slow
def test_lines_of_what_is_no_run_is_one_sentence(tmp_path):
    last = run("lines", tmp_path, code=2).splitlines()[-1]
    assert f"folder={tmp_path} is not the folder of a run" in last
