"""docs/python.md: COIL in TorchRL's PPOTrainer learns, and a learner with their collector."""

import os
import re
import subprocess
import sys

import pytest
import torch
from programs import ROOT

PAGE = (ROOT / "docs" / "python.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)
(TRAINER,) = (block for block in BLOCKS if "PPOTrainer" in block)
(DISTRIBUTED,) = (block for block in BLOCKS if "DistributedCollector" in block)


def run(block):
    torch.manual_seed(0)
    names = {}
    exec(compile(block, "python.md", "exec"), names)
    return names


@pytest.mark.slow
def test_coil_runs_in_their_ppo_trainer():
    before = TRAINER.replace("trainer.train()", "")
    fresh, trained = run(before), run(TRAINER)
    assert trained["trainer"].collected_frames == 1024
    weights = [names["network"].module.layers[0].weight for names in (fresh, trained)]
    changed = (weights[0] - weights[1]).abs()
    assert changed[:, :3].max() > 1e-4
    assert changed[:, 3].max() > 1e-4, "the weights of the advice learn, too"


@pytest.mark.slow
def test_distributed_collector_runs_a_learner(tmp_path):
    file = tmp_path / "distributed_coil.py"  # a file, which each process imports again
    file.write_text(DISTRIBUTED)
    ended = subprocess.run(
        [sys.executable, file],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=600,
        check=True,
    )
    assert [line.split(":")[0] for line in ended.stdout.splitlines()] == [
        f"update {number}" for number in range(4)
    ]
