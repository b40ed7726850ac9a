"""coil-replay: recordings and policies to an annotated recording that another library reads, a table and a picture."""

import csv
import hashlib
import json
import math
import shutil
from pathlib import Path

import pytest
import torch
from drives import drive, store, uncompressed
from mcap.reader import make_reader
from PIL import Image
from programs import called
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from run_folders import make_untrained_run

from coil_rl.envs import SimulatedRobotEnv, read_recording, record_drives
from coil_rl.guides import SplineGuide

SCANS = 15
TRACK = ["track=generated", "track.train.count=1", "learner.action_gain=1.0"]
FILES = {"annotated.mcap", "foxglove_layout.json", "replay.md", "steering.csv", "steering.png"}
POLICIES = ["spline", "coil_seed0", "coil_seed1"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A drive that the spline guide made, and runs of which two have one label."""
    folder = tmp_path_factory.mktemp("replay")
    record_drives(SimulatedRobotEnv(time_limit=SCANS / 5.5, seed=4), SplineGuide(), [folder / "drive.mcap"])
    for seed in (0, 1):
        make_untrained_run(folder / f"coil_{seed}", "method=coil", f"seed={seed}", *TRACK)
    make_untrained_run(folder / "guide", "method=guide", *TRACK[:2])
    return folder


def replayed(folder, *arguments, out="found"):
    return called("replay", "recording=drive.mcap", f"hydra.run.dir={out}", *arguments, cwd=folder)


@pytest.fixture(scope="module")
def done(folder):
    return replayed(folder, "runs=[coil_0,coil_1]"), folder / "found"


@pytest.fixture(scope="module")
def read(done):
    """The messages of each topic and their times, by another library."""
    found, times = {}, {}
    with AnyReader([done[1] / "annotated.mcap"], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for source, time, data in reader.messages():
            found.setdefault(source.topic, []).append(reader.deserialize(data, source.msgtype))
            times.setdefault(source.topic, []).append(time)
    return found, times


def test_files_and_the_printed_table_are_all_there_is(done):
    program, folder = done
    assert {path.name for path in folder.iterdir()} == FILES
    text = (folder / "replay.md").read_text()
    assert program.stdout.startswith(text)
    assert "## drive.mcap (simulated)" in text
    assert "coil_seed1 is coil_1 (last policy)." in text
    last = program.stdout.splitlines()[-1]
    assert last.startswith(f"drive.mcap: {SCANS} scans in 2.5 s; both boundaries valid in ")
    assert last.endswith(f"on average; see {folder}")
    with Image.open(folder / "steering.png") as image:
        assert image.width == 1600


def test_another_library_reads_what_every_policy_would_have_done_at_every_scan(done, read):
    found, times = read
    written = [f"/coil/{name}" for name in ("boundary", "cones", "valid")]
    written += [f"/coil/{policy}/{what}" for policy in POLICIES for what in ("cmd_vel", "steering")]
    assert sorted(found) == sorted([*written, "/cmd_vel", "/odom", "/scan"])
    assert all(times[topic] == times["/scan"] for topic in written)
    with (done[1] / "steering.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == SCANS
    for policy in POLICIES:
        steering = [float(row[f"{policy}/steering"]) * math.radians(80) for row in rows]
        assert [message.data for message in found[f"/coil/{policy}/steering"]] == pytest.approx(steering)
        omega = [float(row[f"{policy}/omega"]) for row in rows]
        assert [message.angular.z for message in found[f"/coil/{policy}/cmd_vel"]] == pytest.approx(omega)
    assert [message.data for message in found["/coil/valid"]] == [row["valid"] == "1" for row in rows]


def test_the_guide_that_drove_agrees_with_the_recorded_command(done):
    with (done[1] / "steering.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        assert float(row["spline/omega"]) == pytest.approx(float(row["recorded/omega"]), abs=1e-3)
        assert abs(float(row["coil_seed0/omega"]) - float(row["coil_seed1/omega"])) < 1.1


def test_the_recording_says_of_what_it_was_made(done, folder):
    with (done[1] / "annotated.mcap").open("rb") as stream:
        reader = make_reader(stream)
        notes = {record.name: record.metadata for record in reader.iter_metadata()}
        attached = {record.name: record.data for record in reader.iter_attachments()}
    assert notes["simulated"]["drive"] == "closed loop"
    assert set(attached) == {"config.yaml", "coil_seed0/config.yaml", "coil_seed1/config.yaml"}
    assert attached["coil_seed1/config.yaml"] == (folder / "coil_1" / "config.yaml").read_bytes()
    assert b"run_dir" not in attached["config.yaml"]

    def digest(content):
        return hashlib.sha256(content).hexdigest()

    assert notes["coil"] == {
        "input_sha256": digest((folder / "drive.mcap").read_bytes()),
        "config_sha256": digest(attached["config.yaml"]),
        **{f"coil_seed{n}_config_sha256": digest(attached[f"coil_seed{n}/config.yaml"]) for n in (0, 1)},
        **{
            f"coil_seed{n}_checkpoint_sha256": digest((folder / f"coil_{n}" / "policy_last.pt").read_bytes())
            for n in (0, 1)
        },
    }


def test_every_topic_of_the_layout_is_in_the_recording(done, read):
    layout = json.loads((done[1] / "foxglove_layout.json").read_text())
    panels = layout["configById"]
    topics = set(panels["3D!scan"]["topics"])
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
    topics |= {path.split(".")[0] for path in paths}
    assert topics <= set(read[0])
    assert {f"/coil/{policy}/steering.data" for policy in POLICIES} < set(paths)
    assert {f"/coil/{policy}/cmd_vel.angular.z" for policy in POLICIES} < set(paths)
    for path in paths:
        topic, *fields = path.split(".")
        value = read[0][topic][0]
        for field in fields:
            value = getattr(value, field)
        assert isinstance(value, (float, bool))
    assert panels["3D!scan"]["followTf"] == read[0]["/scan"][0].header.frame_id

    def shown(place):
        return [place] if isinstance(place, str) else shown(place["first"]) + shown(place["second"])

    assert sorted(shown(layout["layout"])) == sorted(panels)


def test_the_same_replay_makes_the_same_bytes(done, folder):
    torch.rand(3)  # whatever was drawn before
    replayed(folder, "runs=[coil_0,coil_1]", out="again")
    for name in FILES:
        assert (folder / "again" / name).read_bytes() == (folder / "found" / name).read_bytes(), name


def test_several_recordings_get_a_folder_each(tmp_path):
    for name, scans in (("a", 3), ("b", 5)):
        drive(tmp_path / name / "drive.mcap", scans)
    drive(tmp_path / "c.mcap", 4)
    said = called(
        "replay", "recording=[a/drive.mcap,c.mcap,b/drive.mcap]", "guide=zero", "hydra.run.dir=found", cwd=tmp_path
    )
    assert {path.name for path in (tmp_path / "found").iterdir()} == {"drive_1", "c", "drive_2", "replay.md"}
    for name, scans in (("drive_1", 3), ("c", 4), ("drive_2", 5)):
        assert {path.name for path in (tmp_path / "found" / name).iterdir()} == FILES - {"replay.md"}
        assert len(read_recording(tmp_path / "found" / name / "annotated.mcap").ranges) == scans
    assert [line.split(":")[0] for line in said.stdout.splitlines()[-3:]] == ["a/drive.mcap", "c.mcap", "b/drive.mcap"]


def test_of_a_recording_cut_at_60_percent_what_is_readable_is_replayed_and_counted(tmp_path):
    whole = uncompressed(drive(tmp_path / "whole.mcap", 200)).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 6 // 10])
    done = called("replay", "recording=cut.mcap", "guide=zero", "hydra.run.dir=found", cwd=tmp_path)
    scans = len(read_recording(tmp_path / "found" / "annotated.mcap").ranges)
    assert 60 < scans < 120
    assert f"cut.mcap: {scans} scans in " in done.stdout
    assert "all that can be read of a file that is cut off" in done.stdout
    assert "Warning" not in done.stderr
    refused = called("replay", "recording=cut.mcap", "strict=true", "hydra.run.dir=no", cwd=tmp_path, code=2)
    assert refused.stderr == (
        f"replay: env: cut.mcap is cut off: {scans} scans can be read; copy it anew from where it was recorded, "
        "or replay these with strict=false.\n"
    )
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "recording must be given: write recording=VALUE"),
        ("recording=null", "recording must be an MCAP file or a rosbag2 directory"),
        ("recording=[]", "env: recordings is empty; give at least one"),
        ("recording=5", "env.recordings=5 must be"),
        ("recording=missing.mcap", "missing.mcap cannot be read (No such file or directory)"),
        ("recording=[drive.mcap,drive.mcap]", "drive.mcap twice; leave one out"),
        ("recording=text.mcap", "text.mcap is not an MCAP file"),
        ("recording=silent.mcap", "silent.mcap has no scans of a LiDAR"),
        ("recording=drive.mcap env.scan=/lidar", "has no topic /lidar; give the topic of the LiDAR, here /scan"),
        ("recording=drive.mcap env.speed=-1", "env: speed=-1 must be a finite number above 0"),
        ("recording=drive.mcap guide=[]", "there is nobody to ask; give a guide, as in guide=spline, or runs=[FOLDER]"),
        ("recording=drive.mcap guide=constant guide.constant.value=[1,2]", "its action has the shape [1, 2]"),
        ("recording=drive.mcap runs=[nowhere]", "runs=nowhere is not the folder of a run: it has no config.yaml"),
        ("recording=drive.mcap runs=[guide]", "guide has no agent: its guide drives alone"),
        ("recording=drive.mcap runs=[coil_0,./coil_0]", "coil_0 twice; leave one out"),
        ("recording=drive.mcap runs=[coil_0] policy=best", "there is no file coil_0/policy_best.pt"),
        ("recording=drive.mcap runs=[coil_0] policy=worst", "policy='worst' must be 'last' or 'best'"),
        (
            "recording=drive.mcap runs=[coil_0] guide=zero +guide.coil=${guide.zero}",
            "two policies would be called coil; leave one out, or give the guide another name",
        ),
        ("recording=drive.mcap guide=zero +guide.recorded=${guide.zero}", "two policies would be called recorded"),
        ("recording=drive.mcap track=robot", "Could not override 'track'. No match in the defaults list"),
        ("recording=drive.mcap record=1", "there is no key record; the configuration has recording, runs"),
    ],
)
def test_mistakes_are_one_sentence_exit_code_2_and_leave_nothing(arguments, words, folder, tmp_path):
    for name in ("coil_0", "guide"):
        shutil.copytree(folder / name, tmp_path / name)
    shutil.copy(folder / "drive.mcap", tmp_path)
    (tmp_path / "text.mcap").write_text("no recording")
    store(tmp_path / "silent.mcap", b"", kind="std_msgs/msg/Float64", topic="/speed")
    before = sorted(tmp_path.iterdir())
    said = called("replay", *arguments.split(), cwd=tmp_path, code=2).stderr
    assert said.startswith("replay: ")
    assert len(said.splitlines()) == 1
    assert words in said
    assert sorted(tmp_path.iterdir()) == before


def test_shipped_layout_is_one_that_stands_alone():
    layout = json.loads((Path(__file__).parents[3] / "coil_rl" / "replay" / "foxglove_layout.json").read_text())
    assert {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"} == set(layout)
