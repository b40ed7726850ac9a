"""coil-robot."""

import csv
from pathlib import Path

import pytest
import torch
from programs import called
from run_folders import make_untrained_run

from coil_rl.envs import McapReplayEnv, Perception, read_recording, simulated_cone_classifier
from coil_rl.guides import SplineGuide

SHORT = ["evaluation.repeats=1", "env.time_limit=2"]
SMALL = [*SHORT, "figure_25.pairs=2", "figure_25.tests=1"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    for name, *overrides in (
        ("coil", "method=coil", "seed=3"),
        ("residual", "method=residual", "learner.action_gain=1.0"),
        ("guide", "method=guide"),
        ("tasks", "method=ppo", "env=driving_tasks", "observes=[observation,task]"),
    ):
        make_untrained_run(folder / name, "track=robot", "track.train.scale=7", *overrides)
    return folder


@pytest.fixture(autouse=True)
def here(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_all_steps_write_recordings_a_classifier_and_both_pages(runs):
    done = called("robot", *SMALL, f"runs=[{runs}/coil]", "hydra.run.dir=run")
    run = Path("run")
    names = {f"{page}.{ending}" for page in ("figure_25", "table_6") for ending in ("md", "csv", "png")}
    assert {path.name for path in run.iterdir()} - {".hydra"} == {*names, "cones.json", "labelling", "drives"}
    assert {path.name for path in (run / "drives").iterdir()} == {"00_guide_0.mcap", "01_coil_seed3_0.mcap"}
    assert len(list((run / "labelling").iterdir())) == 5
    pages = [(run / f"{page}.md").read_text() for page in ("figure_25", "table_6")]
    last = f"robot: record, train, drive, table done; see {run.absolute()}"
    assert done.stdout == f"{pages[0]}\n{pages[1]}\n{last}\n"
    assert [row["method"] for row in rows_of(run / "table_6.csv")] == ["guide", "coil"]


def test_table_is_reproduced_from_the_recordings(runs):
    called("robot", "steps=[drive,table]", *SHORT, f"runs=[{runs}/coil]", "hydra.run.dir=run")
    assert [row["method"] for row in rows_of(Path("run/table_6.csv"))] == ["guide", "coil"]
    called("robot", "steps=[table]", "recordings=[run/drives]", "hydra.run.dir=again")
    assert Path("again/table_6.csv").read_bytes() == Path("run/table_6.csv").read_bytes()


def test_recorded_command_is_the_transformed_action(runs):
    called("robot", "steps=[drive]", *SHORT, f"runs=[{runs}/residual]", "hydra.run.dir=run")
    recording = read_recording("run/drives/01_residual_seed0_0.mcap")
    guide = McapReplayEnv(recording, Perception(simulated_cone_classifier())).rollout(100, SplineGuide())
    turn_rate = torch.from_numpy(recording.commands[0][:, 1])
    # An untrained residual agent adds little to its guide.
    advised = (guide["action"][0, :, 0] * torch.pi * 80 / 180).sin() * 0.15 / (2 / 7)
    assert 0 < (turn_rate - advised).abs().mean() < 0.2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("steps=[]", "steps=[] must be some of record, train, drive, table"),
        ("steps=[dirve]", "steps=['dirve'] must be some of record, train, drive, table"),
        ("steps=[table]", "recordings is empty and there is no drive; give recordings=[FILE,...]"),
        ("steps=[table] recordings=[none.mcap]", "none.mcap cannot be read (No such file or directory)"),
        ("steps=[train] figure_25.left=[none.mcap]", "figure_25: left=['none.mcap'] and right=[] must both be given"),
        ("runs=[nowhere]", "runs=nowhere is not the folder of a run: it has no config.yaml"),
        ("runs=[{runs}/guide]", "guide has no agent: its guide drives alone; give that guide instead"),
        ("runs=[{runs}/tasks]", "tasks: learner: the env has no entry task to observe; it has observation"),
        ("env=cone_track", "guide drives a ConeTrackEnv; give env=simulated_robot"),
        ("step=[table]", "there is no key step"),
    ],
)
def test_errors_are_one_sentence_and_leave_no_files(arguments, words, runs):
    done = called("robot", *arguments.format(runs=runs).split(), code=2)
    (sentence,) = done.stderr.splitlines()
    assert sentence.startswith("robot: ")
    assert words in sentence
    assert not list(Path().iterdir())
