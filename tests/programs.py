"""Helpers that call the console programs, and the arguments of a very small run."""

import contextlib
import csv
import importlib
import io
import logging
import os
import re
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

from hydra import compose, initialize_config_module
from hydra._internal.hydra import Hydra
from hydra.core.hydra_config import HydraConfig

import coil_fmu.conf
import coil_rl.conf
import coil_robot.conf
import coil_studies.conf

ROOT = Path(__file__).parents[1]
CONF = Path(coil_rl.conf.__path__[0])  # of the library that is tested, which may be a wheel
GUEST_CONFS = (coil_fmu.conf, coil_robot.conf, coil_studies.conf)
CONFS = (CONF, *(Path(each.__path__[0]) for each in GUEST_CONFS))

# Programs outside of coil_rl/programs, by command.
GUESTS = {
    "compare": "coil_rl.comparison.program",
    "export": "coil_rl.export.program",
    "demo": "coil_rl.cones.demo",
    "listen": "coil_studies.listening.program",
    "drive": "coil_robot.programs.drive",
    "replay": "coil_robot.programs.replay",
    "reproduce": "coil_paper.program",
    "guide_benchmark": "benchmarks.guide_benchmark.__main__",
    "promise": "benchmarks.promise",
}
TRACK = ["track=folder", f"track.dir={ROOT / 'tests' / 'ring.csv'}"]
LAP = [*TRACK, "env.laps=1", "env.rate=6"]
SHORT_LAP = [*LAP, "env.time_limit=2"]
TINY = [*SHORT_LAP, "budget.frames=512", "budget.num_envs=8", "budget.steps=32", "logger=none"]
TINY += ["evaluation.repeats=1", "evaluation.curve.env.time_limit=1"]

# Episodes of a second on one track.
SECOND = ["env.laps=1", "env.time_limit=1", "evaluation.curve.env.time_limit=1"]
SECOND += ["evaluation.repeats=1", "logger=none"]
SECOND += ["budget.num_envs=4", "budget.steps=16", "budget.frames=128"]
ONE_SECOND = ["track=generated", "track.train.count=1", "track.test.count=1", *SECOND]
ONE_SECOND += ["evaluation.gif=false"]

# One arm of an experiment on tasks of Gymnasium.
TINY_ARM = ["budget.frames=300", "budget.num_envs=2", "budget.steps=50", "evaluation.cases=2"]
TINY_ARM += ["evaluation.curve.num_envs=2", "evaluation.curve.points=1"]
# The smallest run of any experiment in the cone world.
TINY_SWEEP = ["track=generated", "track.train.count=2", "track.test.count=2", *SECOND]
TINY_SWEEP += ["env.rate=12", "proxy.budget.frames=64"]
TINY_SWEEP += ["proxy.budget.num_envs=2", "proxy.budget.steps=16"]


def composed(*words, name="train", **options):
    """Return the configuration of a program for some words."""
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose(name, [*words], **options)


def code_blocks(page):
    """Return the blocks of code of a page of Markdown, each after its language."""
    return re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def read_csv(path):
    """Return the rows of a table, each a dictionary of texts."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def shipped(group):
    """Return the names of the files of a group of the configuration."""
    return sorted(file.stem for conf in CONFS for file in (conf / group).glob("*.yaml"))


def shipped_file(group, name):
    """Return the path of a file of the configuration."""
    return next(path for conf in CONFS if (path := conf / group / f"{name}.yaml").is_file())


def module(name):
    """Return the module of a program."""
    return GUESTS.get(name, f"coil_rl.programs.{name}")


def command(name, *arguments):
    return [sys.executable, "-m", module(name), *arguments]


def environment(cwd):
    places = [str(ROOT), str(cwd), os.environ.get("PYTHONPATH", "")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(places)}


def program(name, *arguments, cwd, code=0):
    """Run a program in a process of its own, which takes seconds to import PyTorch."""
    options = {"capture_output": True, "text": True, "timeout": 600, "check": False}
    done = subprocess.run(command(name, *arguments), cwd=cwd, env=environment(cwd), **options)
    assert done.returncode == code, done.stderr
    return done


def mode_is_known(name, arguments):
    """Let Hydra not compose the whole configuration once more to find the mode, if it is known.

    A file of an experiment, of other folders or of another package may set it.
    """
    settles = ("experiment", "hydra.mode", "hydra.searchpath", "--config", "-cd", "-cn", "-cp")
    if name == "reproduce" or any(word in each for each in arguments for word in settles):
        return contextlib.nullcontext()
    return patch.object(Hydra, "get_mode", lambda self, config_name, overrides: None)


def called(name, *arguments, cwd=".", code=0):
    """Run a program in this process; `code=None` accepts any exit code."""
    out, error, ended, given = io.StringIO(), io.StringIO(), 0, sys.argv
    words = [*map(str, arguments)]
    sys.argv = [name, *words]
    try:
        with (
            mode_is_known(name, words),
            contextlib.chdir(cwd),
            contextlib.redirect_stderr(error),
            contextlib.redirect_stdout(out),
        ):
            importlib.import_module(module(name)).main()
    except SystemExit as end:
        ended = end.code
    finally:
        sys.argv = given
        HydraConfig.instance().cfg = None  # a later test is no job of this program
        logging.getLogger().handlers.clear()
    assert code is None or ended == code, error.getvalue()
    return subprocess.CompletedProcess(sys.argv, ended, out.getvalue(), error.getvalue())
