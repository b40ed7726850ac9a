"""The two walks through the code in CONTRIBUTING.md name the files that a run goes through."""

import re
import traceback
from pathlib import Path

import pytest
import torch
from programs import TINY, called

from coil_rl.guides import SplineGuide

ROOT = Path(__file__).parents[1]
PACKAGES = ("coil_rl", "envs", "transforms")


def walks():
    text = (ROOT / "CONTRIBUTING.md").read_text().partition("## How the code runs")[2]
    lists = text.partition("\n## ")[0].split("One step of a tensor")
    return [re.findall(r"^\d+\. `([^`]+)`", part, flags=re.MULTILINE) for part in lists]


def files_on_the_stack():
    files = [Path(frame.filename).resolve() for frame in traceback.extract_stack()]
    inside = [file.relative_to(ROOT).as_posix() for file in files if file.is_relative_to(ROOT)]
    return [file for file in inside if file.startswith(PACKAGES)]


@pytest.mark.slow
def test_walks_name_every_file_between_the_command_and_the_optimiser_step_and_the_advice(
    tmp_path, monkeypatch
):
    training, step = walks()
    assert len(training) <= 10 >= len(step)
    assert all((ROOT / file).is_file() for file in (*training, *step))
    stacks = {}
    adam_step, advise = torch.optim.Adam.step, SplineGuide.forward

    def traced_step(self, *args, **kwargs):
        stacks.setdefault("optimiser", files_on_the_stack())
        return adam_step(self, *args, **kwargs)

    def traced_advice(self, tensordict):
        files = files_on_the_stack()
        if "coil_rl/run/rollout.py" in files:
            stacks.setdefault("advice", files[files.index("coil_rl/run/rollout.py") :])
        return advise(self, tensordict)

    monkeypatch.setattr(torch.optim.Adam, "step", traced_step)
    monkeypatch.setattr(SplineGuide, "forward", traced_advice)
    short = [*TINY, "learner.epochs=2", "learner.minibatches=2"]
    # A guide that is not held is asked no more, so the advice is that of COIL.
    for method, *words in (["coil_anchored", "training.tests.time_limit=0.5"], ["coil"]):
        run = f"hydra.run.dir={tmp_path / method}"
        called("train", f"method={method}", *words, *short, run)
    ends = {"coil_rl/programs/train.py", "coil_rl/learners/ppo.py"}
    assert ends <= set(stacks["optimiser"]) <= set(training)
    assert {"transforms/guide_actions.py"} <= set(stacks["advice"]) <= set(step)


def test_tables_name_folders_that_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    rows = re.findall(r"^\| (`[\w/]+/`.*?) \|", text, flags=re.MULTILINE)
    folders = [folder for row in rows for folder in re.findall(r"`([\w/]+/)`", row)]
    assert len(folders) > 15
    for folder in folders:
        assert (ROOT / folder).is_dir() or (ROOT / "coil_rl" / folder).is_dir(), folder
