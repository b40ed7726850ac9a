"""Kill a training run at random moments, resume it, and compare it with an uninterrupted run.

    python tests/kill_and_resume.py --kills 20 [--seed 0] [--folder FOLDER] [OVERRIDES of coil-train
    ...]

Another env than the cones is named by `env=NAME`. Every second kill hits a checkpoint or policy
while it is written, and every second run is killed twice.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing
import os
import random
import re
import sys
import tempfile
import time
from bisect import bisect
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Started by its path, Python would take tests/coil_rl for the library.
sys.path.insert(0, str(ROOT))

import torch  # noqa: E402
from tqdm import tqdm  # noqa: E402

import coil_rl.config.assemble  # noqa: E402, F401  once, and not in each process
import coil_rl.config.check  # noqa: E402, F401
from coil_rl.programs.train import main as train  # noqa: E402
from coil_rl.run import checkpoint  # noqa: E402

SMALL = ["budget.frames=5120", "budget.num_envs=32", "budget.steps=16", "learner.epochs=2"]
SMALL += ["evaluation.repeats=2", "evaluation.gif=false", "checkpoint_every=1"]
CONES = ["track=generated", "track.train.count=1", "track.test.count=1"]
CONES += ["env.laps=1", "env.time_limit=2"]
MILESTONES = ["config.yaml", "guide_return.json", "policy_last.pt", "learning_curve.png"]
MILESTONES += ["lines.png", "evaluation.csv"]
LOGS = ["metrics.csv", "evaluation.csv", "episodes.csv", "guide_return.json"]
STATES = ["policy_last.pt", "checkpoint.pt"]
TIMEOUT = 600  # s


def start(
    folder: Path, overrides: list[str], prepare: Callable[[], object] = lambda: None
) -> BaseProcess:
    """Start a process that begins the run in the folder or resumes it.

    The process is a copy of this one, which has imported PyTorch. `prepare` is called in it.
    """
    begun = (folder / "config.yaml").exists()
    if begun:
        arguments = [f"resume={folder}", *(word for word in overrides if word.startswith("trust="))]
    else:
        other = any(word.startswith("env=") for word in overrides)
        arguments = [*SMALL, *([] if other else CONES), *overrides, f"hydra.run.dir={folder}"]
    process = multiprocessing.get_context("fork").Process(
        target=program, args=(folder, arguments, prepare)
    )
    process.start()
    return process


def program(folder: Path, arguments: list[str], prepare: Callable[[], object]) -> None:
    """Be coil-train, with a log beside the folder of the run."""
    torch.set_num_threads(1)
    os.chdir(folder.parent)
    with Path(f"{folder.name}.log").open("ab") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    prepare()
    sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
    sys.argv = ["coil-train", *arguments]
    train()


def marks(folder: Path) -> int:
    """Return the progress of a run: rows of its log and finished files."""
    log = folder / "metrics.csv"
    rows = log.read_bytes().count(b"\n") if log.exists() else 0
    return rows + sum((folder / name).exists() for name in MILESTONES)


def finish(folder: Path, overrides: list[str]) -> list[float]:
    """Run to the end, and return the seconds until each mark and the end."""
    began, reached = time.monotonic(), []
    process = start(folder, overrides)
    while process.is_alive() and time.monotonic() - began < TIMEOUT:
        reached += [time.monotonic() - began] * (marks(folder) - len(reached))
        time.sleep(0.002)
    process.kill()
    process.join()
    if process.exitcode != 0:
        sys.exit((folder.parent / f"{folder.name}.log").read_text()[-2000:])
    return [*reached, time.monotonic() - began]


def kill(
    folder: Path, overrides: list[str], moment: float, reached: list[float], hit_write: bool
) -> str:
    """Start or resume, kill at a moment of the uninterrupted run, and describe what is left.

    The moment is counted from the mark before it, so that the load of the machine matters less.
    """
    mark = bisect(reached, moment)
    rest = moment - reached[mark - 1]
    process = start(folder, overrides)
    while process.is_alive() and marks(folder) < mark:
        time.sleep(0.002)
    until = time.monotonic() + rest
    while process.is_alive() and (
        time.monotonic() < until or (hit_write and not unfinished(folder))
    ):
        time.sleep(0.0002 if time.monotonic() > until else 0.001)
    ended = not process.is_alive()
    process.kill()
    process.join()
    return f"{moment:.1f} s: " + ("it had ended" if ended else describe_state(folder))


def unfinished(folder: Path) -> list[str]:
    return [name for name in os.listdir(folder) if re.fullmatch(r"\..+\.\d+\.\w+", name)]


def describe_state(folder: Path) -> str:
    if not (folder / "config.yaml").exists():
        return "before the run"
    frames = 0
    if (folder / "metrics.csv").exists():
        with (folder / "metrics.csv").open(newline="") as file:
            frames = max((int(row["frames"]) for row in csv.DictReader(file)), default=0)
    if names := unfinished(folder):
        return f"{frames} frames, writing {', '.join(names)}"
    files = {file.name for file in folder.iterdir()}
    if "checkpoint.pt" not in files:
        between = "checkpoint_previous.pt" in files
        return f"{frames} frames, {'between two renames' if between else 'no checkpoint'}"
    return f"{frames} frames, {'evaluating' if 'policy_last.pt' in files else 'training'}"


def differences(one: Path, other: Path) -> list[str]:
    """Return the files in which two runs differ."""
    wrong = [name for name in LOGS if (one / name).read_bytes() != (other / name).read_bytes()]
    for name in STATES:
        if not same(checkpoint.load(one / name), checkpoint.load(other / name)):
            wrong.append(name)
    return wrong


def same(one: object, other: object) -> bool:
    if isinstance(one, dict) and isinstance(other, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)) and isinstance(other, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    return one == other


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=20, help="number of killed runs")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--folder", type=Path, help="of the runs; temporary by default")
    arguments, overrides = parser.parse_known_args(argv)
    draw, wrong = random.Random(arguments.seed), 0
    with (
        tempfile.TemporaryDirectory() as temporary,
        tqdm(total=arguments.kills + 1, unit="run") as bar,
    ):
        place = (arguments.folder or Path(temporary)).absolute()
        place.mkdir(parents=True, exist_ok=True)
        reached = finish(place / "whole", overrides)
        bar.update()
        print(
            f"uninterrupted run: begins after {reached[0]:.1f} s, ends after {reached[-1]:.1f} s",
            flush=True,
        )
        for number in range(1, arguments.kills + 1):
            folder, hit_write, states = place / f"killed_{number}", number % 2 == 0, []
            for _ in range(1 + (number % 4 >= 2)):
                earliest = reached[max(0, marks(folder) - 1)]
                # After the last figures there are hardly any files to hit.
                moment = draw.uniform(earliest, reached[-3 if hit_write else -1])
                states.append(kill(folder, overrides, moment, reached, hit_write))
            finish(folder, overrides)
            found = differences(place / "whole", folder)
            wrong += bool(found)
            verdict = f"DIFFERENT: {', '.join(found)}" if found else "OK"
            print(f"{number:3}  {'; then '.join(states):90}  {verdict}", flush=True)
            bar.update()
    print(
        f"{arguments.kills - wrong} of {arguments.kills} killed runs "
        "ended like the uninterrupted one"
    )
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
