"""Helpers that call the console programs, and the arguments of a very small run."""

import contextlib
import importlib
import io
import logging
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]

TRACK = ["track=folder", f"track.dir={ROOT / 'tests' / 'ring.csv'}"]
LAP = [*TRACK, "env.laps=1", "env.rate=6"]
TINY = [
    *LAP,
    "budget.frames=512",
    "budget.num_envs=8",
    "budget.steps=32",
    "evaluation.repeats=1",
    "logger=none",
]


def module(name):
    """Return the module of a program."""
    return "coil_paper.program" if name == "reproduce" else f"coil_rl.programs.{name}"


def command(name, *arguments):
    return [sys.executable, "-m", module(name), *arguments]


def environment(cwd):
    return os.environ | {
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(cwd), os.environ.get("PYTHONPATH", "")])
    }


def program(name, *arguments, cwd, code=0):
    """Run a program in a process of its own, which takes seconds to import PyTorch."""
    done = subprocess.run(
        command(name, *arguments),
        cwd=cwd,
        env=environment(cwd),
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == code, done.stderr
    return done


def called(name, *arguments, cwd=".", code=0):
    """Run a program in this process; `code=None` accepts any exit code."""
    out, error, ended, given = io.StringIO(), io.StringIO(), 0, sys.argv
    sys.argv = [name, *arguments]
    try:
        with (
            contextlib.chdir(cwd),
            contextlib.redirect_stderr(error),
            contextlib.redirect_stdout(out),
        ):
            importlib.import_module(module(name)).main()
    except SystemExit as end:
        ended = end.code
    finally:
        sys.argv = given
        logging.getLogger().handlers.clear()
    assert code is None or ended == code, error.getvalue()
    return subprocess.CompletedProcess(sys.argv, ended, out.getvalue(), error.getvalue())
