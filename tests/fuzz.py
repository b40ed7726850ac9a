"""Give damaged and unusual inputs to all programs, and count what must not happen.

    python tests/fuzz.py --cases 10000 [--seed 0] [--minutes N] [--workers N] [--folder FOLDER]
    python tests/fuzz.py --case N [--seed 0]        repeats one case and keeps its files

A case depends on the seed and its number only. It runs in a process that is forked from one with
everything imported, in its own copies of finished runs, recordings, tracks and models. All cases
are listed in FOLDER/cases.jsonl.
"""

import argparse
import faulthandler
import gc
import importlib
import json
import multiprocessing
import os
import random
import re
import resource
import shlex
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
# Started by its path, Python would take tests/coil_rl for the library.
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
# Before torch and tqdm are imported. Without progress bars a refusal is one line.
os.environ |= {
    "TQDM_DISABLE": "1",
    "CUDA_VISIBLE_DEVICES": "",
    "OMP_NUM_THREADS": "1",
    "PYTHONPATH": str(ROOT),
}

import mutations  # noqa: E402
import torch  # noqa: E402
from hydra import compose, initialize_config_module  # noqa: E402
from omegaconf import DictConfig  # noqa: E402
from programs import called, module  # noqa: E402
from tqdm import tqdm  # noqa: E402

from coil_rl.envs import SimulatedRobotEnv, record_drives  # noqa: E402
from coil_rl.guides import SplineGuide  # noqa: E402

# s: of CPU, also where much work may have been asked for, and after a request to stop; by the clock
CPU, PATIENCE, MORE, WALL = 40, 6, 10, 600
MEMORY, FILE = 4 * 2**30, 64 * 2**20  # bytes
FAILURES = ("traceback", "hang", "crash", "sentences", "exit code", "outside", "half-written")

TRACKS = "track=generated track.train.count=1 track.test.count=1"
LAP = "env.laps=1 env.time_limit=1"
SHORT = f"{LAP} evaluation.repeats=1"
CURVE = "evaluation.curve.num_envs=2 evaluation.curve.env.time_limit=1"
TRAIN = (
    f"{SHORT} {CURVE} evaluation.gif=false "
    "budget.frames=32 budget.num_envs=4 budget.steps=8 checkpoint_every=1 "
    "logger=none"
)
PROXY = (
    "proxy.budget.frames=32 proxy.budget.num_envs=4 proxy.budget.steps=8 "
    "proxy.learner.regressor.epochs=1"
)
PHASES = "learner.phases.agent_phase.frames=32 learner.phases.guide_phase.frames=32"
ONCE, MINIBATCHES = "learner.epochs=1 learner.minibatches=2", "learner.minibatches=2"
REPLAY = "learner.starts=16 learner.batch_size=8 learner.capacity=100"
FOREST, GROUPS = (
    "learner.regressor.n_estimators=3 learner.group_key=null",
    "learner.group_key=null",
)
LEARNERS = {
    "ppo": ONCE,
    "a2c": MINIBATCHES,
    "reinforce": MINIBATCHES,
    "trpo": ONCE,
    "dqn": REPLAY,
    "sac": REPLAY,
    "forest": FOREST,
    "linear": GROUPS,
    "network": f"{GROUPS} learner.regressor.epochs=2",
}
RUNS = {
    "ppo": f"method=ppo {ONCE}",
    "coil": f"method=coil {ONCE}",
    "oil": f"method=oil {FOREST}",
    "dynamic": f"method=dynamic_coil_sequential {ONCE} {PROXY} {PHASES} budget.frames=160",
    "dqn": f"method=coil learner=dqn {REPLAY}",
    "learned": f"label=learned method=coil guide=learned guide.learned.run=runs/ppo {ONCE}",
}
USES = {  # of a run
    "evaluate": f"evaluate {TRACKS} evaluation.repeats=1 run=RUN",
    "listen": f"listen {TRACKS} evaluation.repeats=1 donors=2 run=RUN",
    "replay": "replay recording=drive.mcap runs=[RUN]",
    "resume": "train resume=RUN",
    "guide": f"train {TRACKS} {TRAIN} {ONCE} guide=learned guide.learned.run=RUN",
    "distil": f"distill {TRACKS} {SHORT} {CURVE} {PROXY} guide=learned guide.learned.run=RUN",
    "report": "report folder=RUN",
    "reports": "report folder=runs actions=both",
    "robot": "reproduce table=6 results.table_6.repeats=1 results.table_6.laps=1 "
    "results.table_6.runs=[RUN]",
}
POLICY, LOGS = (
    ["config.yaml", "policy_last.pt"],
    ["config.yaml", "metrics.csv", "guide_return.json"],
)
READ = {  # files by use; others are damaged now and then
    "resume": [*LOGS, "checkpoint.pt", "checkpoint_previous.pt", "policy_last.pt"],
    "report": [*LOGS, "evaluation.csv", "episodes.csv"],
}
ON_TRACKS = [
    f"train {TRAIN} {ONCE}",
    f"evaluate {LAP}",
    "evaluate evaluation.repeats=1 run=runs/coil",
]
OF_RECORDINGS = [
    "replay recording=drive.mcap",
    "replay recording=[drive.mcap,other.mcap] runs=[runs/coil]",
    "reproduce figure=25 results.figure_25.left=[drive.mcap,other.mcap]"
    " results.figure_25.right=[drive.mcap,other.mcap] results.figure_25.both=[drive.mcap]",
    "reproduce table=6 budget=smoke results.table_6.recordings=[drive.mcap]",
]
CLASSIFIER = (
    "env.perception.classifier._target_=coil_robot.load_classifier"
    " +env.perception.classifier.path=cones.json"
)
OF_CLASSIFIER = [
    f"evaluate {LAP} env=simulated_robot {CLASSIFIER}",
    f"replay recording=drive.mcap {CLASSIFIER}",
]
COMMANDS = {  # whose arguments are changed; several under a name are drawn from
    "train": [f"train {TRACKS} {TRAIN} {ONCE} method=coil"],
    "distill": [f"distill {TRACKS} {SHORT} {CURVE} {PROXY}"],
    "evaluate": [USES["evaluate"], f"evaluate {TRACKS} {LAP}"],
    "listen": [USES["listen"]],
    "replay": [USES["replay"]],
    "report": [USES["report"], USES["reports"]],
    "reproduce": [
        *(
            f"reproduce budget=smoke {result}"
            for result in ("table=1", "figure=6", "table=[1,7]", "all=maybe")
        ),
        "reproduce claim=tabular_coil results.tabular_coil.worlds=1 "
        "results.tabular_coil.steps=[100]",
        OF_RECORDINGS[-1],
    ],
}
OPTIONS = [
    "",
    "=",
    "=3",
    "a",
    "a=",
    "--nope",
    "-m",
    "--cfg",
    "--cfg=job",
    "--help",
    "--info",
    "--resolve",
    "--config-name=x",
    "--version",
    "--config-dir=levels",
    "--config-path=..",
    "--hydra-help",
    "-p=env",
    "--shell-completion",
    "hydra/launcher=joblib",
    "hydra/launcher=ray",
    "hydra.verbose=true",
    "hydra.mode=MULTIRUN",
    "hydra.job.chdir=true",
    "hydra/job_logging=disabled",
    "hydra.output_subdir=x",
    "seed=0,1",
    "seed=range(0,2)",
    "+experiment=coil_vs_ppo",
    "+guide=random",
    "~learner",
    "~env",
    "a.b.c=1",
    "[1]=2",
    "é=1",
]
UNFINISHED = re.compile(r"\..+\.\d+(\.\w+)?")  # temporary files of atomic writes
HYDRA = re.compile(r"(^|/)\.hydra(/|$)|(^|/)(multirun\.yaml|\.lock)$")
NOTES = re.compile(
    r" continues after update \d+$|using checkpoint_previous\.pt$|runs are missing$"
    r"|^coil-train -m|they are ignored"
)


@dataclass
class Case:
    """A command with damaged files, and what became of it; `given` are its unusual arguments."""

    kind: str
    command: str
    given: list[str] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)
    file_limit: int = FILE
    outcome: str = ""
    failure: str = ""
    cause: str = ""
    seconds: float = 0.0

    @property
    def words(self) -> list[str]:
        """The program and its arguments; options come first."""
        program, *usual = self.command.split()
        fixed = program in ("report", "distill") or "resume=" in self.command
        arguments = [*usual, *([] if fixed else ["hydra.run.dir=out"]), *self.given]
        return [program, *sorted(arguments, key=lambda word: not word.startswith("-"))]

    @property
    def patient(self) -> bool:
        """Whether it may have been asked for more work than there is time for."""
        text = " ".join(self.given + self.damaged)
        return any(str(number) in text for number in mutations.LARGE)


def keys_of(node: DictConfig, path: str = "") -> list[str]:
    """Return the full keys of all values and nodes of a configuration."""
    names = []
    for key in node:
        name = f"{path}.{key!s}".lstrip(".")
        names.append(name)
        value = node._get_node(key)
        if (
            isinstance(value, DictConfig)
            and not value._is_interpolation()
            and not value._is_missing()
        ):
            names += keys_of(value, name)
    return names


def in_hydra(value: Any, draw: random.Random) -> str:
    """Return a value in the grammar of the command line; half of the texts as they are."""
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{in_hydra(item, draw)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(in_hydra(item, draw) for item in value) + "]"
    if isinstance(value, str):
        quoted = value.replace("'", "\\'")
        return draw.choice([value, f"'{quoted}'"])
    return "null" if value is None else str(value).lower()


class Fuzzer:
    """The prepared files, and how a case is drawn, run and judged."""

    def __init__(self, seed: int, folder: Path) -> None:
        self.seed, self.folder, self.base, self.keep = seed, folder, folder / "base", False
        self.deadline = float("inf")
        self.groups: dict[str, list[str]] = {}
        for file in sorted((ROOT / "conf").glob("*/*.yaml")):
            self.groups.setdefault(file.parent.name, []).append(file.stem)
        self.keys = {}
        for program in COMMANDS:
            name = module(program)
            importlib.import_module(name)  # it registers its schema with Hydra
            conf = f"{name.partition('.')[0]}.conf"
            with initialize_config_module(conf, version_base="1.3"):
                keys = keys_of(compose(program, return_hydra_config=True))
            self.keys[program] = [
                key for key in keys if not key.startswith("hydra.") or key.endswith("dir")
            ]
        self._prepare()
        self.repository = self._repository()

    def _prepare(self) -> None:
        """Make the files that cases change, and run every program once.

        So all that the programs need is imported.
        """
        (self.base / "levels").mkdir(parents=True)
        for name in ("a", "b"):
            shutil.copyfile(ROOT / "tests" / "ring.csv", self.base / "levels" / f"{name}.csv")
        shutil.copyfile(ROOT / "envs" / "robot" / "simulated_cones.json", self.base / "cones.json")
        (self.base / "bomb.pkl").write_bytes(mutations.BOMB)
        (self.base / "hubconf.py").write_text(f"import os\nos.system({mutations.MARK!r})\n")
        (self.base / "loop").symlink_to("loop")
        drives = [self.base / "drive.mcap", self.base / "other.mcap"]
        record_drives(SimulatedRobotEnv(num_envs=2, time_limit=3), SplineGuide(), drives)
        for name, overrides in RUNS.items():
            called(
                "train",
                *f"{TRACKS} {TRAIN} {overrides} hydra.run.dir=runs/{name}".split(),
                cwd=self.base,
            )
        for use in USES.values():
            called(*Case("", use.replace("RUN", "runs/coil")).words, cwd=self.base)
        for name in ("out", "outputs"):
            shutil.rmtree(self.base / name)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # the programs have set it
        gc.freeze()  # fewer pages are copied after a fork

    def draw(self, number: int, here: Path) -> Case:
        """Draw a case and put its files into a new folder."""
        draw = random.Random(f"{self.seed} {number}")
        kind = draw.choices(
            ["arguments", "choices", "run", "track", "recording", "model"], [30, 10, 32, 8, 13, 7]
        )[0]
        shutil.copytree(self.base, here, symlinks=True)
        case: Case = getattr(self, f"_{kind}")(draw, here)
        if draw.random() < 0.03:
            case.file_limit = draw.randrange(3000, 40_000)
            case.damaged.append(f"files of at most {case.file_limit} bytes")
        return case

    def _arguments(self, draw: random.Random, here: Path) -> Case:
        """Change values, keys and options."""
        command = draw.choice(COMMANDS[draw.choice([*COMMANDS, "train", "train", "train"])])
        case = Case("arguments", command.replace("RUN", f"runs/{draw.choice(list(RUNS))}"))
        for _ in range(draw.choice([1, 1, 2, 3])):
            (sign,), (end,) = (
                draw.choices(["", "+", "++", "~"], [12, 1, 2, 1]),
                draw.choices(["", "x"], [15, 1]),
            )
            key = f"{sign}{draw.choice(self.keys[command.split()[0]])}{end}"
            value = in_hydra(mutations.junk(draw), draw)
            case.given.append(
                draw.choices(
                    [key if sign == "~" else f"{key}={value}", draw.choice(OPTIONS)], [6, 1]
                )[0]
            )
        return case

    def _choices(self, draw: random.Random, here: Path) -> Case:
        """Combine files of the configuration."""
        method, learner = (
            draw.choice(self.groups["method"]),
            draw.choice([*LEARNERS, "ppo", "dqn", "sac", "trpo"]),
        )
        learner = (
            draw.choice(["forest", "linear", "network"]) if method in ("oil", "dagger") else learner
        )
        given, usual = [f"method={method}"], f"{TRAIN} {PROXY}"
        if method.startswith("dynamic") or method == "kickstart":  # they have learners of their own
            usual += f" {ONCE} {PHASES if method != 'kickstart' else ''}"
        else:
            given.append(f"learner={learner}")
            usual += f" {LEARNERS[learner]}"
        tracks = ["generated", "generated", "folder track.dir=levels", "robot"]
        track = draw.choice([*tracks * 4, "unseen track.test.count=1", "shipped"])
        if "generated" in track:
            track += (
                f" track.train.count={draw.choice([1, 2])} track.test.count={draw.choice([1, 2])}"
            )
        given += f"track={track}".split()
        for group, chance in (("guide", 0.5), ("degrade", 0.4)):
            if draw.random() < chance:
                names = draw.sample(self.groups[group], draw.choice([1, 1, 2]))
                given.append(f"{group}=[{','.join(names)}]")
                given += ["guide.learned.run=runs/ppo"] * ("learned" in names)
        for group, chance in (("preset", 0.3), ("action", 0.3), ("env", 0.3), ("logger", 0.1)):
            if draw.random() < chance:
                given.append(f"{group}={draw.choice(self.groups[group])}")
        if draw.random() < 0.2:
            given.append(f"+degrade@evaluation.advice.other={draw.choice(self.groups['degrade'])}")
        if draw.random() < 0.2:
            given.append("delivery=tested")
        return Case("choices", f"train {usual}", given)

    def _run(self, draw: random.Random, here: Path) -> Case:
        """Damage files of a run, and use it."""
        run, use = draw.choice(list(RUNS)), draw.choice([*USES, "resume"])
        folder, case = here / "runs" / run, Case("run", USES[use].replace("RUN", f"runs/{run}"))
        files = [file for file in folder.rglob("*") if file.suffix not in (".png", ".md")]
        names = sorted(str(file.relative_to(folder)) for file in files)
        likely = [
            name
            for name in names
            if name in READ.get(use.rstrip("s"), POLICY) or name.startswith("proxies")
        ]
        if use == "resume" and draw.random() < 0.8:
            (folder / "evaluation.csv").unlink()
            case.damaged.append("without evaluation.csv")
        for _ in range(draw.choice([1, 1, 2])):
            file = folder / draw.choice(likely if draw.random() < 0.9 else names)
            if not file.parent.is_dir():  # the first damage has put a file in place of its folder
                continue
            if file.suffix == ".pt" and draw.random() < 0.1:
                shutil.copyfile(
                    self.base / "runs" / draw.choice(list(RUNS)) / "checkpoint.pt", file
                )
                case.damaged.append(f"{file.name}: checkpoint of another run")
            else:
                case.damaged.append(mutations.damage(file, draw))
        return case

    def _track(self, draw: random.Random, here: Path) -> Case:
        """Damage a level file, and drive on it."""
        given = ["track=folder", draw.choice(["track.dir=levels", "track.dir=levels/a.csv"])]
        return self._damaged(
            "track", draw.choice(ON_TRACKS), here / "levels" / "a.csv", draw, given
        )

    def _recording(self, draw: random.Random, here: Path) -> Case:
        """Damage a recording, and use it."""
        return self._damaged("recording", draw.choice(OF_RECORDINGS), here / "drive.mcap", draw)

    def _model(self, draw: random.Random, here: Path) -> Case:
        """Damage the cone classifier, or the forest of an imitation, and use it."""
        if draw.random() < 0.5:
            return self._damaged("model", draw.choice(OF_CLASSIFIER), here / "cones.json", draw)
        command = USES[draw.choice(["evaluate", "replay", "guide", "robot"])].replace(
            "RUN", "runs/oil"
        )
        return self._damaged("model", command, here / "runs" / "oil" / "policy_last.pt", draw)

    @staticmethod
    def _damaged(
        kind: str, command: str, file: Path, draw: random.Random, given: list[str] | None = None
    ) -> Case:
        damaged = [mutations.damage(file, draw) for _ in range(draw.choice([1, 1, 2]))]
        return Case(kind, command, given or [], damaged)

    def run(self, number: int) -> Case:
        """Draw a case, run it to its end, judge it and remove its files."""
        place = self.folder / f"case_{number}"
        (place / "outside").mkdir(parents=True)
        case = self.draw(number, place / "here")
        before = self._files(place)
        self._judge(case, place, before, self._start(case, place))
        if not self.keep:
            shutil.rmtree(place, ignore_errors=True)
        return case

    @staticmethod
    def _start(case: Case, place: Path) -> int:
        """Run the program of a case in a forked process and return how it ended."""
        sys.stdout.flush()
        pid = os.fork()
        if pid:
            _, status, used = os.wait4(pid, 0)
            case.seconds = used.ru_utime + used.ru_stime
            return os.waitstatus_to_exitcode(status)
        code = 1
        try:
            for stream, name in ((1, "stdout"), (2, "stderr")):
                os.dup2(os.open(place / name, os.O_WRONLY | os.O_CREAT), stream)
            sys.stdout, sys.stderr = (os.fdopen(stream, "w", closefd=False) for stream in (1, 2))
            _limit(case, place)
            os.environ |= {
                "HOME": str(place / "here"),
                "XDG_CACHE_HOME": str(place.parent / "cache"),
                "MPLCONFIGDIR": str(place / "here" / "outputs"),
                "TMPDIR": str(place / "here" / "outputs"),
            }
            os.chdir(place / "here")
            sys.argv = case.words
            importlib.import_module(module(case.words[0])).main()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        except BaseException:
            traceback.print_exc()
        finally:
            try:
                sys.stdout.flush()
                sys.stderr.flush()
            finally:
                os._exit(code)

    def _judge(self, case: Case, place: Path, before: dict[str, Any], status: int) -> None:
        error, stacks = (
            (place / name).read_text(errors="replace") for name in ("stderr", "stacks")
        )
        lines = [line for line in error.splitlines() if line.strip() and not NOTES.search(line)]
        changed = {name for name, state in self._files(place).items() if before.get(name) != state}
        stopped, repository = status == 130 and case.patient, self._repository()
        outside = {name for name in changed if not _may_write(case, name)}
        outside |= repository - self.repository
        case.outcome = {0: "ran", 2: "refused", 130: "stopped"}.get(status, f"exit code {status}")
        if "Traceback" in error:
            case.failure, case.cause = "traceback", _cause(error)
        elif "File" in stacks and not stopped:
            case.failure = "hang" if case.seconds > PATIENCE else "crash"
            stack = re.split(r"\n(?!  File)", stacks[stacks.find("  File") :])[0]
            # As a traceback, the innermost line last.
            case.cause = _cause("\n".join(stack.splitlines()[::-1]))
        elif status not in (0, 2) and not stopped:
            case.failure = "exit code"
        elif status and (len(lines) != 1 or not lines[0].startswith(f"{case.words[0]}: ")):
            case.failure, case.cause = "sentences", " | ".join(lines)[:200]
        elif outside:
            case.failure, case.cause = "outside", ", ".join(sorted(outside))[:200]
        elif half := _half_written(case, place, changed, status):
            case.failure, case.cause = "half-written", ", ".join(sorted(half))[:200]
        elif status:
            case.cause = lines[0][:300]
        self.repository = repository

    @staticmethod
    def _files(place: Path) -> dict[str, Any]:
        names = {str(path.relative_to(place)): path for path in place.rglob("*")}
        states = {
            name: (path.is_dir(), path.lstat()) for name, path in names.items() if "/" in name
        }
        return {
            name: folder or (state.st_size, state.st_mtime_ns)
            for name, (folder, state) in states.items()
        }

    @staticmethod
    def _repository() -> set[str]:
        found = set()
        for folder, names, files in os.walk(ROOT):
            names[:] = [
                name
                for name in names
                if not name.startswith(".") and name not in ("__pycache__", "outputs")
            ]
            found |= {
                f"{path} {path.lstat().st_mtime_ns}"
                for path in (Path(folder, name) for name in files)
            }
        return found


def _limit(case: Case, place: Path) -> None:
    """Limit time, memory and files of this process.

    At the end of the time it is interrupted, so that it leaves its stack.
    """
    stacks = (place / "stacks").open("w")
    seconds = PATIENCE if case.patient else CPU

    def stop(*_: Any) -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (seconds + MORE, seconds + MORE))
        raise KeyboardInterrupt

    signal.signal(signal.SIGXCPU, stop)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    faulthandler.enable(stacks, all_threads=False)
    faulthandler.register(signal.SIGXCPU, stacks, all_threads=False, chain=True)
    faulthandler.dump_traceback_later(WALL, exit=True, file=stacks)
    memory = MEMORY + int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + MORE))
    resource.setrlimit(resource.RLIMIT_FSIZE, (case.file_limit, case.file_limit))


def _may_write(case: Case, name: str) -> bool:
    """Return whether a program may write a file.

    It may in its own folder, in `outputs`, and where its arguments say.
    """
    if any(re.search(r"dir|folder|path|exp_name|hydra", word) for word in case.given):
        return True
    named = re.findall(r"(?:resume|folder)=(\S+)", case.command)
    return any(f"{name}/".startswith(f"here/{root}/") for root in ("out", "outputs", *named))


def _half_written(case: Case, place: Path, changed: set[str], status: int) -> set[str]:
    """Return unfinished files, and what a refused program left besides finished steps and runs."""
    half = {name for name in changed if UNFINISHED.fullmatch(Path(name).name)}
    if status != 2 or "resume=" in case.command:
        return half
    left = {name for name in changed if not HYDRA.search(name) and (place / name).exists()}
    if case.words[0] in ("train", "distill", "reproduce") or case.file_limit < FILE:
        files = {name for name in left if not (place / name).is_dir()}
        left = {
            name for name in left - files if not any(file.startswith(f"{name}/") for file in files)
        }
        left = {
            name for name in left if Path(name).name not in ("policies", "proxies")
        }  # the run can be resumed
    return half | left


def _cause(text: str) -> str:
    """Return the error and the innermost line of the library in a traceback."""
    frames = re.findall(r'File "([^"]+)", line (\d+),? in (\S+)', text)
    own = [
        frame for frame in frames if frame[0].startswith(str(ROOT)) and "/tests/" not in frame[0]
    ]
    file, line, name = (own or frames or [("?", "?", "?")])[-1]
    errors = re.findall(r"^([\w.]*(?:Error|Exception|Interrupt|Errors))\b", text, re.MULTILINE)
    inner = f" calling {frames[-1][2]}" if own and frames[-1] != own[-1] else ""
    return f"{' '.join(errors[-1:])} {file.removeprefix(f'{ROOT}/')}:{line} {name}{inner}".strip()


fuzzer: Fuzzer


def _run(number: int) -> tuple[int, Case | None]:
    return number, fuzzer.run(number) if time.monotonic() < fuzzer.deadline else None


def main(argv: list[str] | None = None) -> int:
    """Run the cases, print the counts and the causes of failures, and return 1 if there are any."""
    global fuzzer
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--minutes", type=float, default=float("inf"), help="begin no case after this time"
    )
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--case", type=int, help="repeat this case alone and keep its files")
    parser.add_argument(
        "--folder", type=Path, default=ROOT / "outputs" / "fuzz", help="of cases.jsonl"
    )
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    place = Path(tempfile.mkdtemp(prefix="fuzz_"))
    fuzzer = Fuzzer(options.seed, place)
    if options.case is not None:
        fuzzer.keep = True
        repeated, files = fuzzer.run(options.case), place / f"case_{options.case}"
        print(json.dumps(asdict(repeated), indent=2), (files / "stderr").read_text(), sep="\n")
        print(f"coil-{shlex.join(repeated.words)}\nsee {files}")
        return int(bool(repeated.failure))
    begun, cases = time.monotonic(), dict[int, Case]()
    fuzzer.deadline = begun + 60 * options.minutes
    options.folder.mkdir(parents=True, exist_ok=True)
    with (
        multiprocessing.get_context("fork").Pool(options.workers) as pool,
        (options.folder / "cases.jsonl").open("w") as file,
        tqdm(total=options.cases, unit="case", disable=not sys.stderr.isatty()) as bar,
    ):
        for number, case in pool.imap_unordered(_run, range(options.first, options.cases)):
            bar.update()
            if case:
                cases[number] = case
                print(json.dumps({"case": number} | asdict(case)), file=file, flush=True)
    shutil.rmtree(place, ignore_errors=True)
    print(f"{len(cases)} cases of seed {options.seed} in {time.monotonic() - begun:.0f} s")
    return summary(cases)


def summary(cases: dict[int, Case]) -> int:
    """Print the counts, and each distinct failure with its shortest command.

    Return 1 if there are failures.
    """
    columns = ["tries", "ran", "refused", "stopped", *FAILURES, "CPU s"]
    print(f"{'':10}", *(f"{column:>12}" for column in columns))
    for kind in (*sorted({case.kind for case in cases.values()}), ""):
        chosen = [case for case in cases.values() if kind in (case.kind, "")]
        count = Counter(case.failure or case.outcome for case in chosen) | Counter(
            tries=len(chosen)
        )
        cells = [
            *(count[column] for column in columns[:-1]),
            round(sum(case.seconds for case in chosen)),
        ]
        print(f"{kind or 'all':10}", *(f"{cell:12}" for cell in cells))
    groups: dict[tuple[str, str], list[int]] = {}
    for number, case in cases.items():
        if case.failure:
            groups.setdefault(
                (case.failure, re.sub(r"case_\d+|\d{4}-[\d_-]+", "N", case.cause)), []
            ).append(number)
    for (failure, cause), numbers in sorted(groups.items(), key=lambda group: -len(group[1])):
        shortest = min(
            numbers, key=lambda number: len(str(cases[number].given + cases[number].damaged))
        )
        case = cases[shortest]
        usual = case.command.split()[: 1 if case.given else None]
        example = shlex.join([f"coil-{usual[0]}", *usual[1:], *case.given])
        print(
            f"{len(numbers):5} {failure}: {cause}\n"
            f"      --case {shortest}: {example[:300]} {case.damaged or ''}"
        )
    return int(bool(groups))


if __name__ == "__main__":
    sys.exit(main())
