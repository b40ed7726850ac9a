"""The console programs in processes of their own, and the smallest run that goes through all of coil-train."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]

TINY = ["budget.frames=512", "budget.cars=8", "budget.steps=32", "track=generated", "track.train.count=1",
        "track.test.count=1", "env.laps=1", "evaluation.repeats=1", "logger=none"]  # fmt: skip


def program(name, *arguments, cwd, code=0):
    command = [sys.executable, "-m", f"coil_rl.programs.{name}", *arguments]
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(cwd)])}
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == code, done.stderr
    return done
