"""Every env of the configuration takes steps; most train, are killed, resume and are evaluated.

They do so with their guide and with each kind of learner.
"""

import shlex
import signal
import time

import kill_and_resume
import pytest
from programs import called, composed, read_csv, shipped

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
# Those that are not installed for every test.
PACKAGES = {"babyai": "minigrid", "bipedal": "Box2D", "lunar_lander": "Box2D", "swimmer": "mujoco"}
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


def trained(env, learner, folder):
    """Train to the end, evaluate the run again, and return the arguments of the training."""
    overrides = [f"env={env}", *LEARNERS[learner], *TINY, *OWN[env]]
    called("train", *overrides, f"hydra.run.dir={folder}", cwd=folder.parent)
    assert (folder / ("lines.gif" if env in TRACKED else "returns.png")).exists()
    again = ["evaluation.repeats=1", "evaluation.gif=false", "trust=[torchrl]"]
    again += ["hydra.run.dir=again"]
    called("evaluate", f"run={folder}", *again, cwd=folder.parent)
    evaluation = (folder.parent / "again" / "evaluation.csv").read_bytes()
    assert evaluation == (folder / "evaluation.csv").read_bytes()
    return overrides


@pytest.mark.fast(4)
@pytest.mark.parametrize("env", sorted({*FILES} - {*REPLAYS, FMU}))
def test_env_takes_steps_with_the_advice_of_its_guide(env):
    """A new YAML file is driven, too. What it cannot do without belongs into OWN or PACKAGES."""
    if env in PACKAGES:
        pytest.importorskip(PACKAGES[env])
    overrides = [f"env={env}", *OWN.get(env, [])]
    has_guide = bool(composed(*overrides).guide)
    config = composed(*overrides, f"method={'coil' if has_guide else 'ppo'}")
    rollout = env_maker(config)(2).rollout(3, break_when_any_done=False)
    assert rollout.batch_size == (2, 3)
    entries = [*config.observes, "guide_action"] if has_guide else config.observes
    for key in entries:
        assert rollout[key].float().isfinite().all(), key


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
    overrides = trained(env, learner, whole)
    kill(resumed, overrides, kill_and_resume.marks(whole) // 2)
    called("train", f"resume={resumed}", cwd=tmp_path)
    logs = [name for name in kill_and_resume.LOGS if (whole / name).exists()]
    assert len(logs) == 4
    for name in logs:
        assert (resumed / name).read_bytes() == (whole / name).read_bytes(), name


def refusal(folder, *words):
    """Return the sentence that refuses a training, which leaves no file."""
    done = called("train", *words, "hydra.run.dir=run", cwd=folder, code=2)
    (sentence,) = done.stderr.splitlines()
    assert not any(folder.iterdir())
    return sentence


@pytest.mark.parametrize("env", REPLAYS)
def test_replay_without_a_recording_is_refused_before_the_training(env, tmp_path):
    said = refusal(tmp_path, f"env={env}", *LEARNERS["ppo"])
    assert "give at least one MCAP file or rosbag2 folder: recording=FILE" in said


def test_picture_of_what_an_env_does_not_have_is_refused(tmp_path):
    picture = "{_target_: coil_rl.report.DrivenLines, tracks: []}"
    words = ["env=gym", *OTHERS["gym"], "method=ppo", f"+evaluation.pictures.lines={picture}"]
    assert "evaluation.pictures=info.pose is no entry of the env" in refusal(tmp_path, *words)
