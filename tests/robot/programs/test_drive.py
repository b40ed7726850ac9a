"""`coil-drive`: what it drives with, where, and what it refuses."""

import sys

import pytest
from drives import scan
from programs import called
from run_folders import make_untrained_run

from coil_rl.envs.recordings.mcap_files import RecordingWriter, read_messages
from coil_rl.envs.recordings.messages import SCAN, header


class Silent:
    """No controller."""


OWN = ["+controller._target_=drives.SplineDriver", "rate=5.5"]
SHORT = [*OWN, "simulation.seconds=6"]


@pytest.mark.slow
def test_an_object_with_act_and_reset_drives_and_its_log_is_driven_by_again(tmp_path):
    first = called("drive", *SHORT, "hydra.run.dir=first", cwd=tmp_path)
    assert "33 scans (driving 33); the time was over; 0 laps." in first.stdout
    assert "CPU time of a scan: median" in (tmp_path / "first" / "drive.md").read_text()
    words = ["where=recording", "recording=first/drive.mcap", "hydra.run.dir=second"]
    second = called("drive", *OWN, *words, cwd=tmp_path)
    assert "33 scans (driving 33); the recording ended.\n" in second.stdout
    assert {file.name for file in (tmp_path / "second").iterdir()} == {"drive.mcap", "drive.md"}


@pytest.mark.slow
def test_topic_and_scanner_of_a_recording_are_chosen(tmp_path):
    called("drive", *SHORT, "hydra.run.dir=first", cwd=tmp_path)
    rows = read_messages(tmp_path / "first" / "drive.mcap", ["/scan"]).messages["/scan"]
    with RecordingWriter(tmp_path / "two.mcap") as writer:
        for number, row in enumerate(rows):
            rear = scan(number, header=header(row.log_time, "rear"))
            writer.add("/lidar", SCAN, row.log_time, rear)
            writer.copy(row._replace(channel=row.channel._replace(topic="/lidar")))
    words = [*OWN, "where=recording", "recording=two.mcap", "hydra.run.dir=second"]
    done = called("drive", *words, cwd=tmp_path, code=2)
    assert "has no topic /scan; give the topic of the LiDAR, here /lidar." in done.stderr
    done = called("drive", *words, "scan=/lidar", "frame=laser", cwd=tmp_path)
    assert "33 scans (driving 33)" in done.stdout


@pytest.mark.slow
def test_a_policy_drives_with_what_it_was_trained_with(tmp_path):
    words = ["env=simulated_robot", "preset=authors", "+env.max_steering=60", "env.smoothing=0.2"]
    make_untrained_run(tmp_path / "run", "method=coil", *words)
    drive = ["run=run", "policy=last", "simulation.seconds=2"]
    done = called("drive", *drive, "hydra.run.dir=same", cwd=tmp_path)
    assert "with which the policy was trained" not in done.stderr
    given = ["perception.scale=7", "car.max_steering=80", "rate=5"]
    done = called("drive", *drive, *given, "hydra.run.dir=other", cwd=tmp_path)
    changes = "car.max_steering=80 instead of 60, perception.scale=7 instead of 5.625"
    assert f"drive: {changes}, rate=5.0 instead of 5.5, with which" in done.stderr


@pytest.mark.slow
def test_a_run_of_the_cone_world_drives_the_robot(tmp_path):
    words = ["method=guide", "track=generated", "track.test.count=1", "env.time_limit=1"]
    called("train", *words, "evaluation.gif=false", "hydra.run.dir=run", cwd=tmp_path)
    done = called("drive", "run=run", "simulation.seconds=6", cwd=tmp_path)
    assert "33 scans (driving 33)" in done.stdout


@pytest.mark.slow
def test_a_shipped_policy_completes_a_lap_of_the_robot(tmp_path):
    words = ["run=pretrained:cone_track/coil", "simulation.laps=1", "hydra.run.dir=drive"]
    done = called("drive", *words, cwd=tmp_path)
    assert "210 scans (driving 210); the robot completed its laps; 1 laps." in done.stdout


@pytest.mark.fast(10)
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "give what drives: run=FOLDER, or +controller._target_"),
        (["run=nowhere"], "nowhere"),
        ([*OWN, "run=nowhere"], "and not both"),
        ([OWN[0]], "rate is missing"),
        ([*OWN, "where=recording"], "where=recording recording=None do not go together"),
        ([*OWN, "recording=x.mcap"], "do not go together"),
        ([*OWN, "where=recording", "recording=x.mcap"], "x.mcap"),
        ([*OWN, "where=moon"], "where"),
        ([*OWN, "policy=last"], "policy=last has no effect: nothing reads it with a controller"),
        ([*OWN, "scan=/x"], "scan=/x has no effect: nothing reads it with a controller and where="),
        ([*OWN, "ros.stamped=true"], "ros.stamped=true has no effect"),
        ([*OWN, "where=ros", "simulation.laps=1"], "simulation.laps=1 has no effect"),
        ([*OWN, "+simulation.lap=1"], "lap"),
        ([*OWN, "perception.range_max=far"], "perception.range_max='far' must be"),
        ([*OWN, "smoothing=-1"], "smoothing=-1.0 must be"),
        ([*OWN, "lift_after=-1"], "lift_after"),
        ([*OWN[1:], f"+controller._target_={__name__}.Silent"], "cannot drive"),
        pytest.param(
            [*OWN, "where=ros"],
            "where=ros needs ROS 2",
            marks=pytest.mark.skipif("rclpy" in sys.modules, reason="ROS 2 is here"),
        ),
    ],
)
def test_mistakes_are_refused_in_one_sentence(words, message, tmp_path):
    done = called("drive", *words, cwd=tmp_path, code=2)
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
