"""The two walks through the code in CONTRIBUTING.md name the files that a run goes through."""

import re
import traceback
from pathlib import Path

import torch
from programs import TINY, called

from coil_rl.guides import SplineGuide

ROOT = Path(__file__).parents[1]
PACKAGES = ("coil_rl", "envs", "transforms")


def walks():
    text = (
        (ROOT / "CONTRIBUTING.md")
        .read_text()
        .partition("## How the code runs")[2]
        .partition("\n## ")[0]
    )
    lists = text.split("One env step with advice")
    return [re.findall(r"^\d+\. `([^`]+)`", part, flags=re.MULTILINE) for part in lists]


def files_on_the_stack():
    files = [Path(frame.filename).resolve() for frame in traceback.extract_stack()]
    inside = [file.relative_to(ROOT).as_posix() for file in files if file.is_relative_to(ROOT)]
    return [file for file in inside if file.startswith(PACKAGES)]


def test_walks_name_every_file_between_the_command_and_the_optimiser_step_and_the_advice(
    tmp_path, monkeypatch
):
    training, step = walks()
    assert all(
        len(walk) <= 10 and all((ROOT / file).is_file() for file in walk)
        for walk in (training, step)
    )
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
    called("train", "method=coil", *TINY, "budget.frames=256", f"hydra.run.dir={tmp_path / 'run'}")
    assert (
        {"coil_rl/programs/train.py", "coil_rl/learners/ppo.py"}
        <= set(stacks["optimiser"])
        <= set(training)
    )
    assert {"transforms/guide_actions.py"} <= set(stacks["advice"]) <= set(step)
