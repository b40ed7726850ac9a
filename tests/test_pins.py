"""Seeded runs whose logs and tables are compared with the ones in `tests/pins/`.

After a change that is meant to alter numbers,
`python tests/test_pins.py` writes the pins again, in that change's commit.
"""

import math
import shutil
import tempfile
from pathlib import Path

import pytest
from programs import LAP, called, read_csv

PINS = Path(__file__).parent / "pins"
FILES = ("metrics.csv", "evaluation.csv")
SMALL = [*LAP, "budget.frames=2048", "budget.num_envs=8", "budget.steps=64", "logger=none"]
SMALL += ["evaluation.repeats=1", "evaluation.gif=false"]
RUNS = {
    "ppo": ["method=ppo"],
    "coil": ["method=coil"],
    # A network: on another machine trees choose other splits, and least squares other weights.
    "dagger": ["method=dagger", "learner=network", "learner.regressor.epochs=5"],
    "dynamic_coil_sequential": [
        "method=dynamic_coil_sequential",
        "guide=[spline,undertuned]",
        "learner.phases.agent_phase.frames=512",
        "learner.phases.guide_phase.frames=512",
        "proxy.budget.frames=512",
        "budget.frames=11008",  # 8960 of the two proxies, a batch of 14 x 320 each, are among them
        "proxy.learner.regressor.epochs=5",
    ],
    "sac": [
        "method=coil",
        "learner=sac",
        "learner.starts=256",
        "learner.updates_per_step=0.0078125",
    ],
}
# relative; on one machine the numbers are the same to the bit, on another they round differently
TOLERANCE = 1e-4


def run(name: str, folder: Path) -> Path:
    called("train", *SMALL, *RUNS[name], f"hydra.run.dir={folder / name}", cwd=folder)
    return folder / name


def same(one: str, other: str) -> bool:
    try:
        return one == other or math.isclose(
            float(one), float(other), rel_tol=TOLERANCE, abs_tol=1e-6
        )
    except ValueError:
        return False


@pytest.mark.fast("coil")
@pytest.mark.parametrize("name", RUNS)
def test_short_run_gives_the_pinned_numbers(name: str, tmp_path: Path) -> None:
    folder = run(name, tmp_path)
    for file in FILES:
        found, pinned = read_csv(folder / file), read_csv(PINS / name / file)
        assert [list(row) for row in found] == [list(row) for row in pinned], file
        wrong = []
        for number, (row, pin) in enumerate(zip(found, pinned, strict=True)):
            for column, value in pin.items():
                if not same(row[column], value):
                    wrong.append(f"{file} row {number} {column}: {row[column]} instead of {value}")
        assert not wrong, wrong[:10]


if __name__ == "__main__":
    import torch

    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        for name in RUNS:
            made = run(name, Path(folder))
            (PINS / name).mkdir(parents=True, exist_ok=True)
            for file in FILES:
                shutil.copy(made / file, PINS / name / file)
