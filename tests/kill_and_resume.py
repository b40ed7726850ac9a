"""Kills a training at random moments, lets it go on, and compares it with one that was never stopped.

    python tests/kill_and_resume.py --kills 20 [--seed 0] [--folder FOLDER] [what coil-train takes ...]

Every second kill waits for the next checkpoint or policy that is being written, and every second run is killed twice.
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from bisect import bisect
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Started by its path, Python would take tests/coil_rl for the library.
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402
from tqdm import tqdm  # noqa: E402

from coil_rl.train import checkpoint  # noqa: E402

SMALL = ["budget.frames=10240", "budget.cars=32", "budget.steps=16", "track=generated", "track.train.count=1",
         "track.test.count=1", "env.laps=1", "env.time_limit=2", "evaluation.repeats=2", "evaluation.gif=false",
         "learner.epochs=2", "checkpoint_every=1"]  # fmt: skip
MILESTONES = ["config.yaml", "guide_return.json", "policy_last.pt", "learning_curve.png", "lines.png", "evaluation.csv"]
LOGS = ["metrics.csv", "evaluation.csv", "episodes.csv", "guide_return.json"]
STATES = ["policy_last.pt", "policy_best.pt", "checkpoint.pt"]
PATIENCE = 600  # s that a process may take


def start(folder: Path, overrides: list[str]) -> subprocess.Popen[bytes]:
    """A process that begins a run in the folder, or goes on with the one that is there."""
    begun = (folder / "config.yaml").exists()
    arguments = [f"resume={folder}"] if begun else [*SMALL, *overrides, f"hydra.run.dir={folder}"]
    env = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with (folder.parent / f"{folder.name}.log").open("ab") as log:
        command = [sys.executable, "-m", "coil_rl.programs.train", *arguments]
        return subprocess.Popen(command, cwd=folder.parent, env=env, stdout=log, stderr=log)


def marks(folder: Path) -> int:
    """How far a run has come: rows of its log and files it is done with."""
    rows = (folder / "metrics.csv").read_bytes().count(b"\n") if (folder / "metrics.csv").exists() else 0
    return rows + sum((folder / name).exists() for name in MILESTONES)


def finish(folder: Path, overrides: list[str]) -> list[float]:
    """Run to the end; returns the seconds after which each mark was reached, and the end."""
    began, reached = time.monotonic(), []
    process = start(folder, overrides)
    while process.poll() is None and time.monotonic() - began < PATIENCE:
        reached += [time.monotonic() - began] * (marks(folder) - len(reached))
        time.sleep(0.002)
    process.kill()
    if process.wait() != 0:
        sys.exit((folder.parent / f"{folder.name}.log").read_text()[-2000:])
    return [*reached, time.monotonic() - began]


def kill(folder: Path, overrides: list[str], moment: float, reached: list[float], aim: bool) -> str:
    """Start or go on, kill at a moment of the run that was never stopped, and tell what the kill hit.

    The moment is found by the marks before it, so that it is the same on a machine that is busier now.
    """
    mark = bisect(reached, moment)
    rest = moment - reached[mark - 1]
    process = start(folder, overrides)
    while process.poll() is None and marks(folder) < mark:
        time.sleep(0.002)
    until = time.monotonic() + rest
    while process.poll() is None and (time.monotonic() < until or (aim and not unfinished(folder))):
        time.sleep(0.0002 if time.monotonic() > until else 0.001)
    ended = process.poll() is not None
    process.kill()
    process.wait()
    return f"{moment:.1f} s: " + ("it had ended" if ended else scene(folder))


def unfinished(folder: Path) -> list[str]:
    return [name for name in os.listdir(folder) if re.fullmatch(r"\..+\.\d+\.\w+", name)]


def scene(folder: Path) -> str:
    if not (folder / "config.yaml").exists():
        return "before the run"
    frames = 0
    if (folder / "metrics.csv").exists():
        with (folder / "metrics.csv").open(newline="") as file:
            frames = max((int(row["frames"]) for row in csv.DictReader(file)), default=0)
    files = {file.name for file in folder.iterdir()}
    doing = "training" if "checkpoint.pt" in files else "before the first checkpoint"
    if "policy_last.pt" in files:
        doing = "evaluating"
    if "checkpoint_previous.pt" in files and "checkpoint.pt" not in files:
        doing = "between two renames"
    elif unfinished(folder):
        doing = "writing " + ", ".join(re.sub(r"\.(.+)\.\d+(\.\w+)", r"\1\2", name) for name in unfinished(folder))
    return f"{frames} frames, {doing}"


def differences(one: Path, other: Path) -> list[str]:
    """The files of a run that another does not have to the bit."""
    wrong = [name for name in LOGS if (one / name).read_bytes() != (other / name).read_bytes()]
    return wrong + [name for name in STATES if not same(checkpoint.load(one / name), checkpoint.load(other / name))]


def same(one: object, other: object) -> bool:
    if isinstance(one, dict) and isinstance(other, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    return one == other


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20, help="runs that are killed")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--folder", type=Path, help="where the runs go; by default a temporary one")
    given, overrides = parser.parse_known_args(arguments)
    draw, wrong = random.Random(given.seed), 0
    with tempfile.TemporaryDirectory() as temporary, tqdm(total=given.kills + 1, unit="run") as bar:
        place = (given.folder or Path(temporary)).absolute()
        place.mkdir(parents=True, exist_ok=True)
        reached = finish(place / "whole", overrides)
        bar.update()
        print(
            f"never stopped: there is a run after {reached[0]:.1f} s, and its end after {reached[-1]:.1f} s", flush=True
        )
        for number in range(1, given.kills + 1):
            folder, aim, scenes = place / f"killed_{number}", number % 2 == 0, []
            for _ in range(1 + (number % 4 >= 2)):
                earliest = reached[max(0, marks(folder) - 1)]
                # After the last pictures there is hardly a file left to aim at.
                moment = draw.uniform(earliest, reached[-3 if aim else -1])
                scenes.append(kill(folder, overrides, moment, reached, aim))
            finish(folder, overrides)
            found = differences(place / "whole", folder)
            wrong += bool(found)
            verdict = f"DIFFERENT: {', '.join(found)}" if found else "OK"
            print(f"{number:3}  {'; then '.join(scenes):90}  {verdict}", flush=True)
            bar.update()
    print(f"{given.kills - wrong} of {given.kills} killed runs ended as the one that was never stopped")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
