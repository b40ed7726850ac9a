"""Imitation of recorded drives by one command, tested in a closed loop."""

import math
import shutil

import odd_recordings as odd
import pytest
import torch
from programs import called, read_csv
from torchrl.envs import TransformedEnv

import coil_rl
from coil_rl.config.assemble import LearnedGuide
from coil_rl.config.parts import env_maker
from coil_rl.envs import McapReplayEnv, Perception, SimulatedRobotEnv, record_drives
from coil_rl.envs import simulated_cone_classifier as classifier
from coil_rl.envs.splines import least_squares_parabola
from coil_rl.export import export_policy
from coil_rl.guides import SplineGuide
from coil_rl.run import checkpoint
from coil_rl.run.parts import TEST
from coil_rl.transforms import GuideActions

SCANS = 33
# A second of one robot is enough to see that it drives.
SHORT = [
    "env=mcap_replay",
    "learner=linear",
    "evaluation.cases=1",
    "+evaluation.env.time_limit=1",
    "logger=none",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three drives, of which the last is one in which commands end and the robot stands."""
    folder = tmp_path_factory.mktemp("drives")
    files = [folder / "a.mcap", folder / "b.mcap", folder / "c.mcap"]
    record_drives(SimulatedRobotEnv(num_envs=3, time_limit=SCANS / 5.5), SplineGuide(), files)
    drive = odd.messages_of(files[2])
    odd.commands_end_early(drive)  # the twelfth is the last one, and counts for three turns
    drive.commands[3:6] = [(time, odd.twist(0.0, 0.0)) for time, _ in drive.commands[3:6]]
    odd.write(files[2], drive)
    return folder


def trained(folder, *arguments, code=0):
    words = ["method=oil", *SHORT, "hydra.run.dir=run", *arguments]
    return called("train", *words, cwd=folder, code=code)


@pytest.mark.slow
def test_recorded_steering_is_learned_and_the_imitation_drives(folder):
    done = trained(folder, "recording=[a.mcap,b.mcap,c.mcap]", "hydra.run.dir=three")
    assert "a.mcap: 33 of 33 scans are learned; left out: 0 without" in done.stdout
    assert "c.mcap: 12 of 33 scans are learned; left out: 18 without" in done.stdout
    assert "3 of a robot that stands" in done.stdout
    assert "3 recordings: 78 of 99 scans are learned." in done.stdout
    last = read_csv(folder / "three" / "metrics.csv")[-1]
    assert (float(last["learner/samples"]), float(last["learner/left_out"])) == (78.0, 21.0)
    assert {row["driver"] for row in read_csv(folder / "three" / "evaluation.csv")} == {"oil"}
    assert "laps" in (folder / "three" / "evaluation.md").read_text()

    samples = checkpoint.load(folder / "three" / "dataset.pt")
    env = McapReplayEnv([folder / f"{name}.mcap" for name in "abc"], Perception(classifier()))
    usable = ~env.known["stale"] & ~env.known["standing"]
    # The samples are in the order of the rows, which are the recordings.
    torch.testing.assert_close(samples["action"].squeeze(-1), env.known["recorded"][usable])
    tracks = samples["info"]["track"].squeeze(-1)
    assert torch.bincount(tracks).tolist() == [33, 33, 12]


def test_the_test_drives_the_car_of_the_recordings():
    words = ["method=oil", "env=mcap_replay", "env.speed=0.3", "env.car_length=0.6"]
    words += ["env.max_steering=40", "env.spline=quadratic", "env.perception.range_max=1.6"]
    words += ["env.perception.scale=5", "env.perception.bearing_max=90", "run_dir=unused"]
    env = env_maker(coil_rl.compose_train(words)).bare(1, TEST, None)
    assert isinstance(env, SimulatedRobotEnv)
    assert env.step_length * env.rate == pytest.approx(0.3)
    assert (env.car_length, env.max_steering) == (0.6, math.radians(40))
    assert env.memory.fit is least_squares_parabola
    seen = env.perception
    assert (seen.range_max, seen.scale, seen.bearing_max, seen.laser_yaw) == (1.6, 5, 90, 0)


@pytest.mark.slow
def test_data_set_is_the_first_round_of_dagger(folder):
    trained(folder, "recording=[a.mcap,b.mcap]", "hydra.run.dir=two")
    arguments = ["method=dagger", "env=simulated_robot", "guide=spline", "learner=linear"]
    arguments += ["env.time_limit=1", "evaluation.curve.points=1", "evaluation.gif=false"]
    arguments += ["budget.num_envs=2", "budget.steps=5", "budget.frames=20", "logger=none"]
    arguments += ["learner.dataset=two/dataset.pt", "hydra.run.dir=dagger"]
    called("train", *arguments, cwd=folder)
    rows = read_csv(folder / "dagger" / "metrics.csv")
    assert [float(row["learner/samples"]) for row in rows[1:]] == [76.0, 86.0]


@pytest.mark.slow
def test_run_is_evaluated_and_replayed_like_any_other(folder):
    trained(folder, "recording=[a.mcap,b.mcap]", "hydra.run.dir=again")
    called("evaluate", "run=again", "hydra.run.dir=evaluated", cwd=folder)
    assert read_csv(folder / "evaluated" / "evaluation.csv")[0]["driver"] == "oil"
    arguments = ["recording=a.mcap", "runs=[again]", "hydra.run.dir=replayed"]
    assert "| oil " in called("replay", *arguments, cwd=folder).stdout


@pytest.mark.slow
def test_recording_that_is_there_twice_is_refused(folder, tmp_path):
    shutil.copy(folder / "a.mcap", tmp_path / "copy.mcap")
    done = trained(folder, f"recording=[a.mcap,{tmp_path / 'copy.mcap'}]", code=2)
    assert "hold the same scans; leave one of them out" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("learner", ["forest", "linear", "network"])
def test_imitated_policy_is_a_controller_a_guide_an_export_and_drives(learner, folder, monkeypatch):
    monkeypatch.chdir(folder)
    words = [*SHORT[2:], f"learner={learner}", "recording=[a.mcap,b.mcap]"]
    run = coil_rl.train("mcap_replay", method="oil", overrides=words, folder=f"of_{learner}")
    seen = {"observation": torch.linspace(-1, 1, 20).numpy()}
    action = float(run.controller().act(seen)[0])
    exported = export_policy(run, f"{learner}_file", observations=9)
    assert float(exported.act(seen)[0]) == pytest.approx(action, abs=1e-5)
    guides = GuideActions({"imitation": LearnedGuide(str(run.folder))})
    env = TransformedEnv(SimulatedRobotEnv(num_envs=2), guides)
    data = env.reset()
    first = run.controller().act({"observation": data["observation"][0].numpy()})
    assert float(data["guide_action"][0, 0, 0]) == pytest.approx(float(first[0]), abs=1e-6)
    if learner == "forest":
        done = called("drive", f"run={run.folder}", "simulation.seconds=2", cwd=folder)
        assert "driving" in done.stdout


@pytest.mark.fast(3)
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["recording=null"], "env: recordings is empty"),
        (["recording=nothing.mcap"], "env: nothing.mcap cannot be read"),
        (["budget.num_envs=1"], "env.num_envs=1 leaves out episodes, of which there are 2"),
        (["budget.frames=20", "budget.steps=10"], "longest has 33, so the others would be"),
        (["recording=a.mcap"], "one track or episode, which cannot be left out to validate"),
        (["method=ppo", "learner=ppo"], "method=ppo cannot learn there"),
        (["method=dagger"], "method=dagger cannot learn there"),
        (
            ["method=coil", "env=cone_track", "learner=ppo", "guide=recording"],
            "guide.recording: it reads info.recorded",
        ),
    ],
)
def test_mistakes_are_one_sentence(folder, arguments, words):
    done = trained(folder, "recording=[a.mcap,b.mcap]", *arguments, "hydra.run.dir=no", code=2)
    sentence = done.stderr.splitlines()[-1]
    assert sentence.startswith("train: ")
    assert words in sentence
    assert not (folder / "no").exists()


def test_recordings_without_commands_cannot_be_imitated(folder, tmp_path):
    drive = odd.messages_of(folder / "a.mcap")
    drive.commands = []
    odd.write(tmp_path / "silent.mcap", drive)
    arguments = ["recording=silent.mcap", "learner.group_key=null"]
    done = trained(tmp_path, *arguments, code=2)
    assert "no scan has recorded steering to learn" in done.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_imitation_of_three_drives_completes_its_laps(tmp_path):
    files = [tmp_path / f"{name}.mcap" for name in "abc"]
    env = SimulatedRobotEnv(num_envs=3, laps=2, time_limit=100.0, seed=11)
    record_drives(env, SplineGuide(), files)
    arguments = ["method=oil", "env=mcap_replay", "recording=[a.mcap,b.mcap,c.mcap]"]
    called("train", *arguments, "logger=none", "hydra.run.dir=run", cwd=tmp_path)
    drives = read_csv(tmp_path / "run" / "episodes.csv")
    assert len(drives) == 6
    assert sum(float(row["laps"]) for row in drives) >= 10
