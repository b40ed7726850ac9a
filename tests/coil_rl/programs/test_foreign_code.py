"""A fault in an env or controller of somebody else ends every program with one sentence."""

import textwrap
import warnings

import numpy as np
import pytest
from programs import called, read_csv

import coil_rl

SOURCE = """
import gymnasium
import numpy as np
from gymnasium import spaces


class Plant(gymnasium.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    steps = 0  # of all envs of this process

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time, self.x = 0, self.np_random.uniform(-1, 1, 2)
        return self.x.astype(np.float32), {}

    def step(self, action):
        self.time += 1
        self.x = 0.9 * self.x + 0.1 * action[0]
        reward = -float(np.abs(self.x).sum())
        return self.x.astype(np.float32), reward, False, self.time == 12, {}

    def render(self):
        return np.zeros((4, 4, 3))  # not uint8


class Told(Plant):
    def step(self, action):
        *rest, _ = super().step(action)
        info = {"time": self.time}
        return *rest, info | {"late": self.time > 5} if self.time > 1 else info


class Raises(Plant):
    def step(self, action):
        assert self.time < 11, "the pump is off"
        return super().step(action)


class TrainingOnly(Plant):
    seeds = set()

    def reset(self, *, seed=None, options=None):
        self.seed = seed
        return super().reset(seed=seed)

    def step(self, action):
        answer = super().step(action)
        return answer[:4] if self.seed < 1_000_000_000 and self.time == 11 else answer


class TableOnly(Plant):
    def step(self, action):
        answer = super().step(action)
        of_table = self.np_random_seed in range(10**9, 11 * 10**8)
        return answer[:4] if of_table and self.time == 11 else answer


class Unseeded(Plant):
    numbers = np.random.default_rng()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time, self.x = 0, self.numbers.uniform(-1, 1, 2)
        return self.x.astype(np.float32), {}


class Late:
    calls = 0

    def act(self, observation):
        self.calls += 1
        return None if self.calls == 11 else [-observation[0]]
"""
TINY = [
    *("env=gym", "budget.num_envs=2", "budget.steps=16", "budget.frames=64", "logger=none"),
    *("evaluation.cases=2", "evaluation.curve.num_envs=2", "evaluation.curve.points=1"),
    *("learner=ppo", "learner.minibatches=2", "hydra.run.dir=run"),
]
ALONE = ["env=gym", "env.id=odd_plants:Plant", "evaluation.cases=2", "hydra.run.dir=run"]


@pytest.fixture(autouse=True)
def plants(tmp_path, monkeypatch):
    (tmp_path / "odd_plants.py").write_text(textwrap.dedent(SOURCE))
    monkeypatch.syspath_prepend(tmp_path)


LATE = ["guide=controller", "guide.controller.of=odd_plants:Late"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "words", "message"),
    [
        ("train", [*TINY, "env.id=odd_plants:Raises"], "step raised AssertionError: the pump is"),
        ("evaluate", [*ALONE, *LATE], "the controller odd_plants:Late (row 0, step 10)"),
    ],
)
def test_fault_ends_a_program_with_one_sentence(program, words, message, tmp_path):
    said = called(program, *words, "evaluation.gif=false", cwd=tmp_path, code=2).stderr
    lines = [line for line in said.splitlines() if line.startswith(f"{program}: ")]
    (line,) = [line for line in lines if "frame/s" not in line]  # of the progress bar
    assert message in line
    assert "Traceback" not in said


@pytest.mark.slow
@pytest.mark.parametrize(("env", "is_kept"), [("TrainingOnly", False), ("TableOnly", True)])
def test_fault_says_how_to_go_on_with_what_is_kept(env, is_kept, tmp_path):
    words = [*TINY, "method=ppo", f"env.id=odd_plants:{env}", "evaluation.gif=false"]
    done = called("train", *words, cwd=tmp_path, code=2)
    going_on = "what is finished is kept: correct the cause and continue with coil-train resume="
    assert (going_on in done.stderr) == ("continue with" in done.stderr) == is_kept


@pytest.mark.slow
def test_env_that_ignores_its_seed_and_cannot_draw_is_trained_with_warnings(tmp_path):
    words = [*TINY, "method=ppo", "env.id=odd_plants:Unseeded", "evaluation.gif=true"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        called("train", *words, cwd=tmp_path)
    said = " ".join(str(each.message) for each in caught)
    assert "other values of observation: the env does not obey its seed" in said
    assert "no pictures of the env: render returned" in said
    assert (tmp_path / "run" / "evaluation.csv").exists()


@pytest.mark.slow
def test_flag_of_info_says_which_steps_count_and_a_run_is_measured_again(tmp_path):
    words = [*TINY, "method=ppo", "env.id=odd_plants:Told", "env.info=[late]"]
    measure = "evaluation.measures.after"
    counted = [f"{measure}.reduction=count", f"{measure}.where=[info,late]"]
    words += [f"{measure}.entry=[info,late]", *counted, "evaluation.gif=false"]
    called("train", *words, cwd=tmp_path)
    again = ["run=run", "trust=[odd_plants]", "hydra.run.dir=again", "env.info=[time]"]
    again.append("evaluation.measures.end={entry: [info, time], reduction: last}")
    called("evaluate", *again, cwd=tmp_path)
    found = {name: read_csv(tmp_path / name / "episodes.csv") for name in ("run", "again")}
    assert {row["after"] for row in found["run"]} == {"7.0"}, "steps 6 to 12"
    assert {row["after"] for row in found["again"]} == {"7.0"}
    assert {row["end"] for row in found["again"]} == {"12.0"}
    assert (tmp_path / "again" / "in_time.png").exists()


class Model:
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.float32(-observation[:1]), state


@pytest.mark.slow
def test_model_of_another_library_is_a_guide_in_one_line(tmp_path):
    words = [word for word in TINY[1:] if not word.startswith(("hydra", "budget.frames"))]
    words.append("evaluation.gif=false")
    folder = tmp_path / "a=b c"
    given = {"guide": Model(), "frames": 64, "folder": folder, "overrides": words}
    run = coil_rl.train("odd_plants:Plant", **given)
    table = run.evaluate()
    opened = coil_rl.open_run(folder, guide=Model(), trust=["odd_plants"]).evaluate()
    assert table["reward"].tolist() == opened["reward"].tolist()
    assert (table["driver"] == "guide").any()
