"""Every env of the configuration takes steps; most train, are killed, resume and are evaluated.

They do so with their guide and with each kind of learner.
"""

import shlex
import signal
import time

import kill_and_resume
import pytest
from programs import TINY_ARM, called, composed, read_csv, shipped

from coil_rl.config.parts import env_maker

FILES = shipped("env")
REPLAYS = ["mcap_replay"]  # of recordings, see config/test_replay.py
FMU = "fmu"  # of a file, see tests/fmu
# Envs of other libraries, without tracks and guides.
OTHERS = {
    "gym": shlex.split("env.id=Pendulum-v1 env.max_steps=12"),
    "torchrl": shlex.split(
        "env.of._target_=torchrl.envs.PendulumEnv env.max_steps=12 observes=[th,thdot]"
    ),
}
SMALL_CASES = shlex.split("evaluation.cases=3 evaluation.curve.num_envs=2 evaluation.gif=false")
# Those of Gymnasium: what each needs, and the least mean reward of its public controller.
OF_GYMNASIUM = {
    "lunar_lander": ("Box2D", 200),
    "bipedal": ("Box2D", -200),
    "mountain_car": ("gymnasium", 88),
    "pendulum": ("gymnasium", -400),
    "cart_pole": ("gymnasium", 500),
    "swimmer": ("mujoco", 300),
    "babyai": ("minigrid", 0.5),
}
TRACKED = ["cone_track", "driving_tasks", "simulated_robot"]
TINY = shlex.split(
    "evaluation.repeats=1 logger=none checkpoint_every=1 "
    "budget.frames=256 budget.num_envs=4 budget.steps=16"
)
SHORT = shlex.split("env.laps=1 env.time_limit=1 evaluation.curve.env.time_limit=1")
OWN = dict.fromkeys(TRACKED, SHORT)
OWN |= {env: [*overrides, *SMALL_CASES] for env, overrides in OTHERS.items()}
PPO = ["learner.epochs=2", "learner.minibatches=2"]
REPLAY = shlex.split(
    "learner.capacity=1000 learner.starts=64 learner.batch_size=32 learner.updates_per_step=0.03125"
)
LEARNERS = {
    "ppo": ["method=ppo", *PPO],
    "dqn": ["method=coil", "learner=dqn", *REPLAY],
    "sac": ["method=coil", "learner=sac", *REPLAY],
    "sac_alone": ["method=ppo", "learner=sac", *REPLAY],
    "crossq": ["method=residual", "learner=crossq", *REPLAY],
    "tqc": ["method=coil_anchored", "learner=tqc", "learner.n_step=3", *REPLAY],
}


def kill(folder, overrides, mark):
    """Start a run in a process of its own and kill it at a mark."""
    process = kill_and_resume.start(folder, overrides)
    began = time.monotonic()
    while process.is_alive() and kill_and_resume.marks(folder) < mark:
        assert time.monotonic() < began + kill_and_resume.TIMEOUT
        time.sleep(0.002)
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL, "the run ended before it was killed"
    assert not (folder / "evaluation.csv").exists()


def words_of(env, learner):
    return [f"env={env}", *LEARNERS[learner], *TINY, *OWN[env]]


def check_evaluation(env, folder):
    """Check that the evaluation of a finished run gives its table again."""
    assert (folder / ("lines.gif" if env in TRACKED else "returns.png")).exists()
    again = ["evaluation.repeats=1", "evaluation.gif=false", "trust=[torchrl]"]
    called("evaluate", f"run={folder}", *again, "hydra.run.dir=again", cwd=folder.parent)
    evaluation = (folder.parent / "again" / "evaluation.csv").read_bytes()
    assert evaluation == (folder / "evaluation.csv").read_bytes()


def trained(env, learner, folder):
    called("train", *words_of(env, learner), f"hydra.run.dir={folder}", cwd=folder.parent)
    check_evaluation(env, folder)


@pytest.mark.fast(4)
@pytest.mark.parametrize("env", sorted({*FILES} - {*REPLAYS, FMU}))
def test_env_takes_steps_with_the_advice_of_its_guide(env):
    """A new YAML file is driven, too. What it cannot do without belongs into OWN."""
    if env in OF_GYMNASIUM:
        pytest.importorskip(OF_GYMNASIUM[env][0])
    overrides = [f"env={env}", *OWN.get(env, [])]
    has_guide = bool(composed(*overrides).guide)
    config = composed(*overrides, f"method={'coil' if has_guide else 'ppo'}")
    rollout = env_maker(config)(2).rollout(3, break_when_any_done=False)
    assert rollout.batch_size == (2, 3)
    entries = [*config.observes, "guide_action"] if has_guide else config.observes
    for key in entries:
        assert rollout[key].float().isfinite().all(), key


@pytest.mark.slow
@pytest.mark.parametrize("env", OF_GYMNASIUM)
def test_controller_of_an_env_is_evaluated(env, tmp_path):
    package, least = OF_GYMNASIUM[env]
    pytest.importorskip(package)
    called("evaluate", f"env={env}", "evaluation.cases=2", "hydra.run.dir=run", cwd=tmp_path)
    rows = read_csv(tmp_path / "run" / "evaluation.csv")
    rewards = {row["case"]: float(row["reward"]) for row in rows}
    assert rewards["mean"] >= least


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [["env.options.continuous=false"], ["guide=none", "method=ppo"]]
)
def test_lunar_lander_trains_with_discrete_actions_and_without_a_guide(options, tmp_path):
    pytest.importorskip("Box2D")
    short = [*TINY_ARM, "env.max_steps=60", "evaluation.gif=false", "logger=none", *options]
    called("train", "env=lunar_lander", *short, "hydra.run.dir=run", cwd=tmp_path)
    assert (tmp_path / "run" / "evaluation.csv").exists()


@pytest.mark.slow
@pytest.mark.parametrize("env", [*TRACKED, *OTHERS])
def test_env_trains_and_is_evaluated_in_its_own_cases(env, tmp_path):
    trained(env, "ppo", tmp_path / "run")
    rows = read_csv(tmp_path / "run" / "evaluation.csv")
    cases = {row["case"] for row in rows} - {"mean"}
    assert (cases == {"0", "1", "2"}) == (env in OTHERS)
    assert ("completed" in rows[0]) == (env in TRACKED)
    assert ("guide" in {row["driver"] for row in rows}) == (env in TRACKED)


@pytest.mark.slow
@pytest.mark.parametrize("env", OTHERS)
def test_env_without_a_guide_trains_with_replay(env, tmp_path):
    trained(env, "sac_alone", tmp_path / "run")


# Every learner with replay in one env, and every env with PPO; test_methods resumes each method.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "learner"),
    [
        *((TRACKED[0], learner) for learner in LEARNERS if learner != "sac_alone"),
        *((env, "ppo") for env in TRACKED[1:]),
    ],
)
def test_killed_run_of_an_env_ends_like_an_uninterrupted_one(env, learner, tmp_path, monkeypatch):
    monkeypatch.setattr(kill_and_resume, "SMALL", [])
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    trained(env, learner, whole)
    kill(resumed, words_of(env, learner), kill_and_resume.marks(whole) // 2)
    called("train", f"resume={resumed}", cwd=tmp_path)
    logs = [name for name in kill_and_resume.LOGS if (whole / name).exists()]
    assert len(logs) == 4
    for name in logs:
        assert (resumed / name).read_bytes() == (whole / name).read_bytes(), name
