"""coil-replay."""

import functools
import hashlib
import json
import math
import re
import shutil

import numpy as np
import pytest
import torch
from drives import PERIOD, START, by_another_library, drive, rosbag_of, scan, uncompressed
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from programs import called, read_csv
from run_folders import make_untrained_run

from coil_paper.reproduce.robot import Table6
from coil_rl.envs import SimulatedRobotEnv, read_recording, record_drives
from coil_rl.envs.recordings.mcap_files import RecordingWriter
from coil_rl.envs.recordings.messages import SCAN, TWIST_STAMPED, header, twist
from coil_rl.guides import SplineGuide
from coil_robot.programs.replay import _run_names, _topic_name

SCANS = 15
TRACK = ["track=generated", "track.train.count=1", "learner.action_gain=1.0"]
FILES = {"annotated.mcap", "foxglove_layout.json", "replay.md", "steering.csv", "steering.png"}
POLICIES = ["spline", "coil_seed0", "coil_seed1"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A drive of the spline guide, and runs, two of them with the same label."""
    folder = tmp_path_factory.mktemp("replay")
    robot = SimulatedRobotEnv(time_limit=SCANS / 5.5, seed=4)
    record_drives(robot, SplineGuide(), [folder / "drive.mcap"])
    for seed in (0, 1):
        make_untrained_run(folder / f"coil_{seed}", "method=coil", f"seed={seed}", *TRACK)
    make_untrained_run(folder / "guide", "method=guide", *TRACK[:2])
    return folder


def replayed(folder, *arguments, out="results"):
    return called("replay", "recording=drive.mcap", f"hydra.run.dir={out}", *arguments, cwd=folder)


def replayed_with_zero(folder, recording):
    arguments = [f"recording={recording}", "guide=zero", "hydra.run.dir=results"]
    return called("replay", *arguments, cwd=folder)


@pytest.fixture(scope="module")
def done(folder):
    return replayed(folder, "runs=[coil_0,coil_1]"), folder / "results"


@pytest.fixture(scope="module")
def rows(done):
    return read_csv(done[1] / "steering.csv")


@pytest.fixture(scope="module")
def messages(done):
    return by_another_library(done[1] / "annotated.mcap")[0]


@pytest.mark.slow
def test_files_and_printed_table(done):
    program, folder = done
    assert {path.name for path in folder.iterdir()} == FILES
    text = (folder / "replay.md").read_text()
    assert program.stdout.startswith(text)
    assert "Warning" not in text
    assert "replay: drive.mcap" not in program.stderr
    assert f"coil_seed1 is {folder.parent / 'coil_1'} (policy handed_over)." in text
    assert f"\ndrive.mcap: {SCANS} scans in 2.5 s, 5.5 a second; " in program.stdout


def test_annotated_recording_agrees_with_the_csv(messages, rows):
    topics = [f"/coil/{name}" for name in ("boundary", "cones", "valid")]
    topics += [f"/coil/{policy}/{what}" for policy in POLICIES for what in ("cmd_vel", "steering")]
    assert sorted(messages) == sorted([*topics, "/cmd_vel", "/odom", "/scan"])
    assert len(rows) == SCANS
    for policy in POLICIES:
        angles = [message.data for message in messages[f"/coil/{policy}/steering"]]
        steering = [float(row[f"{policy}/steering"]) * math.radians(80) for row in rows]
        assert angles == pytest.approx(steering)
        turn_rates = [message.angular.z for message in messages[f"/coil/{policy}/cmd_vel"]]
        assert turn_rates == pytest.approx([float(row[f"{policy}/omega"]) for row in rows])
    valid = [message.data for message in messages["/coil/valid"]]
    assert valid == [row["valid"] == "1" for row in rows]
    expected = [float(row["recorded/omega"]) for row in rows]
    assert [float(row["spline/omega"]) for row in rows] == pytest.approx(expected, abs=1e-3)


def test_annotated_recording_notes_its_inputs(done, folder):
    with (done[1] / "annotated.mcap").open("rb") as stream:
        reader = make_reader(stream)
        notes = {record.name: record.metadata for record in reader.iter_metadata()}
        attached = {record.name: record.data for record in reader.iter_attachments()}
    assert set(attached) == {"config.yaml", "coil_seed0/config.yaml", "coil_seed1/config.yaml"}
    assert attached["coil_seed1/config.yaml"] == (folder / "coil_1" / "config.yaml").read_bytes()
    expected = {"input": (folder / "drive.mcap").read_bytes(), "config": attached["config.yaml"]}
    for n in (0, 1):
        expected[f"coil_seed{n}_config"] = attached[f"coil_seed{n}/config.yaml"]
        checkpoint = folder / f"coil_{n}" / "policy_last.pt"
        expected[f"coil_seed{n}_checkpoint"] = checkpoint.read_bytes()
    digests = {f"{key}_sha256": hashlib.sha256(data).hexdigest() for key, data in expected.items()}
    assert notes["coil"] == digests


def test_topics_of_the_foxglove_layout_are_in_the_recording(done, messages):
    panels = json.loads((done[1] / "foxglove_layout.json").read_text())["configById"]
    assert set(panels["3D!scan"]["topics"]) <= set(messages)
    paths = {path["value"] for panel in panels.values() for path in panel.get("paths", [])}
    assert {f"/coil/{policy}/steering.data" for policy in POLICIES} < paths
    for path in paths:
        topic, *fields = path.split(".")
        assert isinstance(functools.reduce(getattr, fields, messages[topic][0]), (float, bool))


@pytest.mark.slow
def test_same_replay_makes_the_same_bytes(done, folder):
    torch.rand(3)  # earlier draws have no effect
    replayed(folder, "runs=[coil_0,coil_1]", out="again")
    for name in FILES:
        first, second = (folder / out / name for out in ("results", "again"))
        assert first.read_bytes() == second.read_bytes(), name


@pytest.mark.slow
def test_each_of_several_recordings_has_a_folder(tmp_path):
    for name, scans in (("a", 3), ("b", 5)):
        drive(tmp_path / name / "drive.mcap", scans)
    drive(tmp_path / "c.mcap", 4)
    paths = "[a/drive.mcap,c.mcap,b/drive.mcap]"
    out = replayed_with_zero(tmp_path, paths).stdout
    results = tmp_path / "results"
    assert {path.name for path in results.iterdir()} == {"drive_1", "c", "drive_2", "replay.md"}
    for name, scans in (("drive_1", 3), ("c", 4), ("drive_2", 5)):
        assert {path.name for path in (results / name).iterdir()} == FILES - {"replay.md"}
        assert len(read_recording(results / name / "annotated.mcap").ranges) == scans
    names = [line.split(":")[0] for line in out.splitlines()[-3:]]
    assert names == ["a/drive.mcap", "c.mcap", "b/drive.mcap"]


def test_recording_without_boundaries_is_replayed_with_a_warning(tmp_path):
    scan = {"angle_min": -math.pi, "angle_increment": math.pi / 180, "range_max": 12.0}
    with RecordingWriter(tmp_path / "room.mcap") as writer:
        for time in range(3):
            writer.add("/scan", SCAN, time * 10**8, {**scan, "ranges": np.full(360, 0.8)})
    sentence = replayed_with_zero(tmp_path, "room.mcap").stderr.splitlines()[-1]
    words = "no scan shows both boundaries and 100% of the clusters in sight are unlike any cone"
    assert sentence.startswith(f"replay: room.mcap: {words}")
    warning = f"Warning: {sentence.removeprefix('replay: ')}."
    assert warning in (tmp_path / "results" / "replay.md").read_text()


@pytest.mark.slow
def test_recording_that_is_cut_off_is_replayed_as_far_as_it_goes(tmp_path):
    whole = uncompressed(drive(tmp_path / "whole.mcap", 200)).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 6 // 10])
    done = replayed_with_zero(tmp_path, "cut.mcap")
    scans = len(read_recording(tmp_path / "results" / "annotated.mcap").ranges)
    assert 60 < scans < 120
    assert f"the file is cut off: {scans} scans can be read" in done.stdout
    assert "Warning" not in done.stderr
    arguments = ["recording=cut.mcap", "strict=true", "hydra.run.dir=no"]
    refused = called("replay", *arguments, cwd=tmp_path, code=2)
    assert "replay: env: cut.mcap is cut off" in refused.stderr


def test_recorded_steering_is_that_of_table_6(tmp_path):
    """The robot has another speed than the replay's, two scanners, and stamped commands."""
    messages = []
    for number in range(40):
        command = {"header": header(START, "base_link")}
        command["twist"] = twist(0.3, 0.4 * math.sin(number))
        messages.append(("/cmd_vel", TWIST_STAMPED, START + 60_000_000 * number, command))
    for number in range(12):
        time = START + number * PERIOD
        for n in (0, 1):
            fields = scan(number, header=header(time, f"laser_{n}"))
            messages.append(("/scan", SCAN, time + n, fields))
    rosbag_of(tmp_path / "drive", *messages)
    arguments = "recording=drive guide=zero frame=laser_1 hydra.run.dir=results"
    out = called("replay", *arguments.split(), cwd=tmp_path).stdout
    [row] = [line.split("|") for line in out.splitlines() if line.startswith("| recorded")]
    Table6(recordings=[str(tmp_path / "results" / "annotated.mcap")]).make(tmp_path / "table")
    [measured] = read_csv(tmp_path / "table.csv")
    assert float(measured["smoothness"]) == pytest.approx(float(row[2]), abs=5e-4) != 0
    panels = json.loads((tmp_path / "results" / "foxglove_layout.json").read_text())["configById"]
    assert "/cmd_vel.twist.angular.z" in [path["value"] for path in panels["Plot!omega"]["paths"]]


@given(st.text("aZ09_-. =,/日é", max_size=8))
def test_any_label_becomes_a_topic_name(label):
    assert re.fullmatch(r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*", _topic_name(label))
    assert _topic_name(_topic_name(label)) == _topic_name(label)


def test_equal_labels_are_distinguished_by_seed_and_then_by_number():
    assert _run_names(["ppo", "coil"], [0, 0]) == ["ppo", "coil"]
    assert _run_names(["coil", "ppo", "coil"], [1, 1, 0]) == ["coil_seed1", "ppo", "coil_seed0"]
    assert _run_names(["coil", "coil"], [0, 0]) == ["coil_seed0_1", "coil_seed0_2"]


@pytest.mark.fast(3)
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "recording must be given: write recording=VALUE"),
        ("recording=null", "recording must be an MCAP file or a rosbag2 folder"),
        ("recording=[]", "env: recordings is empty; give at least one"),
        ("recording=missing.mcap", "missing.mcap cannot be read (No such file or directory)"),
        ("recording=[drive.mcap,drive.mcap]", "drive.mcap twice; leave one out"),
        ("recording=drive.mcap frame=rear", "no scan with the frame rear; give frame=laser"),
        ("recording=drive.mcap guide=[]", "there is no policy; give a guide"),
        (
            "recording=drive.mcap guide=constant guide.constant.value=[1,2]",
            "guide.constant: the action of guide 'constant' has the shape [1, 2]",
        ),
        ("recording=drive.mcap runs=[nowhere]", "nowhere is not the folder of a run"),
        ("recording=drive.mcap runs=[guide]", "guide has no agent: its guide drives alone"),
        ("recording=drive.mcap policy=last", "policy=last has no effect: nothing in a replay with"),
        ("recording=drive.mcap env.num_envs=2", "env.num_envs=2 has no effect: each recording has"),
        ("recording=drive.mcap env.smooth=-1", "env.smooth=-1 has no effect: a replay earns no"),
        ("recording=drive.mcap runs=[coil_0,./coil_0]", "coil_0 twice; leave one out"),
        ("recording=drive.mcap runs=[coil_0] policy=best", "must be 'handed_over' or 'last'"),
        (
            "recording=drive.mcap runs=[coil_0] guide=zero +guide.coil=${guide.zero}",
            "policies would be called coil",
        ),
        (
            "recording=drive.mcap guide=zero +guide.recorded=${guide.zero}",
            "two policies would be called recorded",
        ),
    ],
)
def test_errors_are_one_sentence_and_leave_no_files(arguments, words, folder, tmp_path):
    for name in ("coil_0", "guide"):
        shutil.copytree(folder / name, tmp_path / name)
    shutil.copy(folder / "drive.mcap", tmp_path)
    before = sorted(tmp_path.iterdir())
    (sentence,) = called("replay", *arguments.split(), cwd=tmp_path, code=2).stderr.splitlines()
    assert sentence.startswith("replay: ")
    assert words in sentence
    assert sorted(tmp_path.iterdir()) == before
