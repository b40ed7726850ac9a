import os
import signal
import subprocess
import sys
import time

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from worlds import drive, reloaded, same

from coil_rl import GymnasiumEnv, compose_train
from coil_rl.config.parts import env_maker
from coil_rl.foreign.faults import ForeignError
from coil_rl.foreign.workers import choose
from coil_rl.run.parts import TEST, TRAIN


class Plant(gymnasium.Env):
    """A drifting number; it may fail, die or be slow at a step."""

    def __init__(self, fails=None, dies=None, most=9.0, ends=9, seconds=0.0):
        self.fails, self.dies, self.most, self.ends = fails, dies, most, ends
        self.seconds = seconds
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float64)
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time, self.state = 0, self.np_random.normal(size=3)
        return self.state, {"time": 0}

    def step(self, action):
        self.time += 1
        time.sleep(self.seconds)
        if self.time == self.fails:
            raise RuntimeError("a valve is stuck")
        if action.sum() > self.most:
            raise RuntimeError("a fuse has blown")
        if self.time == self.dies:
            os.kill(os.getpid(), signal.SIGKILL)
        self.state = self.state + 0.1 * self.np_random.normal(size=3) + action.sum()
        return (
            self.state,
            float(self.state.sum()),
            self.time == self.ends,
            False,
            {"time": self.time},
        )


class Integrator:
    """A controller with a memory."""

    def __init__(self, env):
        self.total = np.zeros(2)

    def reset(self):
        self.total = np.zeros(2)

    def act(self, observation):
        self.total = self.total - 0.1 * observation[:2]
        return np.clip(self.total, -1, 1)


def plants(workers, rows=5, **options):
    return GymnasiumEnv(
        Plant,
        rows,
        options=options,
        controllers={"integrator": Integrator},
        info=["time"],
        seed=3,
        workers=workers,
    )


@pytest.mark.parametrize("workers", [2, 3, 100, "auto"])
def test_digits_do_not_depend_on_the_number_of_processes(workers) -> None:
    alone, _ = drive(plants(0), 25)
    spread, _ = drive(plants(workers), 25)
    assert same(alone, spread)


@pytest.mark.parametrize(("before", "after"), [(2, 0), (0, 3), (2, 2)])
def test_running_episodes_go_on_with_another_number_of_processes(before, after) -> None:
    env = plants(before)
    _, carrier = drive(env, 13)
    other = plants(after)
    other.load_state_dict(reloaded(env.state_dict()))
    assert other.continues
    expected, _ = drive(env, 20, carrier, seed=1)
    found, _ = drive(other, 20, carrier, seed=1)
    assert same(expected, found)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fails": 4}, r"the env Plant \(row 0, seed \d+, step 4\): step raised .*a valve is"),
        ({"dies": 4}, "held the rows 0 to 1 of the env Plant ended by signal 9"),
    ],
)
def test_fault_in_a_process_is_one_sentence_with_its_rows(options, message) -> None:
    with pytest.raises(ForeignError, match=message):
        drive(plants(2, **options), 6)


def test_fault_of_a_late_row_names_that_row() -> None:
    env = plants(2, most=1.5)
    carrier = env.reset()
    carrier["action"] = torch.zeros(5, 2, dtype=env.action_spec.dtype)
    carrier["action"][3] = 1.0
    with pytest.raises(ForeignError, match=r"row 3, .*: a fuse has blown"):
        env.step(carrier)


@pytest.mark.parametrize("workers", [-1, 1.5, "many", True, 10_000])
def test_number_of_processes_is_checked(workers) -> None:
    message = r"workers=.* must be 'auto' or (at (least|most)|a valid int)"
    with pytest.raises(ValueError, match=message):
        plants(workers)


@pytest.mark.parametrize(
    ("seconds", "count"), [(1e-6, 0), (1e-3, min(2, len(os.sched_getaffinity(0)))), (None, 0)]
)
def test_long_steps_are_spread_over_the_cores(seconds, count) -> None:
    found = choose("auto", 2, lambda: seconds and 2 * seconds, "Plant", {})
    assert found == (count if count > 1 else 0)


def test_envs_of_a_run_are_timed_once(monkeypatch) -> None:
    timed = []
    monkeypatch.setattr("coil_rl.foreign.gymnasium_env.timed", lambda *_: timed.append(1))
    make = env_maker(compose_train(["env=pendulum", "method=ppo"]))
    for rows, cases in ((2, TRAIN), (4, TEST)):
        make(rows, cases).reset()
    assert len(timed) == (len(os.sched_getaffinity(0)) > 1)


def test_a_slow_plant_is_spread_by_itself() -> None:
    env = plants("auto", seconds=0.004)
    env.reset()
    assert (env.workers is None) == (len(os.sched_getaffinity(0)) < 2)


@pytest.mark.slow
def test_warnings_of_a_process_reach_the_program() -> None:
    env = plants(2, rows=2, ends=None)
    with pytest.warns(UserWarning, match="did not end within 1,000 steps"):
        drive(env, 1_000)


@pytest.mark.skipif(sys.platform != "linux", reason="there is no affinity")
def test_each_process_has_a_core_if_there_are_as_many() -> None:
    cores = os.sched_getaffinity(0)
    each, more = [{core} for core in sorted(cores)], [cores] * (len(cores) + 1)
    for expected in (each, more):
        env = plants(len(expected), rows=len(expected))
        env.reset()
        found = [os.sched_getaffinity(process.pid) for process in env.workers.processes]
        assert found == expected
        env.close()
    assert os.sched_getaffinity(0) == cores


def test_processes_end_with_the_env() -> None:
    env = plants(2)
    env.reset()
    processes = env.workers.processes
    env.close()
    assert not any(process.is_alive() for process in processes)


# Forks a program for each signal, because imports take seconds. One that is started in the
# background ignores SIGINT.
PROGRAM = """
import os, signal, sys, time
sys.path.insert(0, {tests!r})
from test_workers import plants
signal.signal(signal.SIGINT, signal.default_int_handler)
programs = []
for _ in range({count}):
    programs.append(os.fork())
    if not programs[-1]:
        env = plants(2)
        env.reset()
        pids = [os.getpid(), *[process.pid for process in env.workers.processes]]
        os.write(1, (" ".join(map(str, pids)) + "\\n").encode())  # whole beside the others
        time.sleep(60)
for program in programs:
    os.waitpid(program, 0)
"""


def started(program: str, count: int = 1, **options) -> subprocess.Popen:
    """Start a program that finds this file."""
    paths = os.pathsep.join(path for path in sys.path if path)
    words = [sys.executable, "-c", program.format(tests=os.path.dirname(__file__), count=count)]
    options |= {"stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen(words, env=os.environ | {"PYTHONPATH": paths}, **options)


class Simulator(Plant):
    """The plant with something that it must release, here a file that it removes."""

    def __init__(self, file, fails=None):
        super().__init__(fails)
        self.file = file.with_suffix(f".{os.getpid()}_{id(self)}")
        self.file.touch()

    def close(self):
        self.file.unlink()


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "fails"), [(0, None), (2, None), ("auto", None), ("auto", 1)])
def test_envs_are_closed_in_their_processes(workers, fails, tmp_path) -> None:
    options = {"file": tmp_path / "licence", "fails": fails}
    env = GymnasiumEnv(Simulator, 3, options=options, workers=workers)
    env.reset()
    assert len(list(tmp_path.iterdir())) >= 3
    env.close()
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_no_process_outlives_its_program(tmp_path) -> None:
    errors = tmp_path / "errors"
    kinds = [signal.SIGKILL, signal.SIGTERM, signal.SIGINT]
    parent = started(PROGRAM, count=len(kinds), stderr=errors.open("w"))
    for kind in kinds:
        program, *workers = map(int, parent.stdout.readline().split())
        assert len(workers) == 2
        assert _runs(program), errors.read_text()
        os.kill(program, kind)
        deadline = time.monotonic() + 10
        while any(map(_runs, [program, *workers])) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not any(map(_runs, [program, *workers])), kind
    assert parent.wait(10) == 0


def _runs(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_rows_of_one_process_have_the_spaces_of_all() -> None:
    made = iter(range(100))

    def uneven():
        env = Plant()
        if next(made) == 1:
            env.observation_space = spaces.Box(-1, 1, (3,))
        return env

    with pytest.raises(ValueError, match="all envs of a run need the same spaces"):
        GymnasiumEnv(uneven, 4, workers=2).reset()


def test_env_with_processes_gives_the_same_pictures() -> None:
    pictures = []
    for workers in (0, 2):
        env = GymnasiumEnv(
            "CartPole-v1", 4, workers=workers, render=True, first_seed=1, cases=2, seed=1
        )
        drive(env, 3)
        pictures.append(np.stack([env.render(row) for row in (0, 2)]))
    assert np.array_equal(*pictures)


# An object with a finalizer of its own, made before anything else, changes the order of the end.
OPEN_AT_THE_END = """
import sys, weakref
class Tool: pass
tool = Tool()
weakref.finalize(tool, print, "ended")
sys.path.insert(0, {tests!r})
from test_workers import plants
env = plants(2)
env.reset()
"""


@pytest.mark.slow
def test_program_ends_while_an_env_is_open() -> None:
    ended = started(OPEN_AT_THE_END, stderr=subprocess.PIPE)
    out, error = ended.communicate(timeout=60)
    assert (out, ended.returncode) == ("ended\n", 0), error
