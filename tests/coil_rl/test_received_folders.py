"""Test of folders of somebody else: pipes, devices and huge numbers are refused in one sentence."""

import os
import shutil

import pytest
from run_folders import driven, make_run

from coil_rl.config.folder import read_config
from coil_rl.config.nodes import build
from coil_rl.errors import UserError
from coil_rl.guides.recorded import RecordedGuide
from coil_rl.learners.dynamic_coil import PhaseSchedule
from coil_rl.report.runs import read_runs
from coil_rl.run import checkpoint
from coil_rl.run.folder import report_changed_versions
from coil_rl.run.judge import report_outcome
from coil_rl.run.metrics import Metrics
from coil_robot.classifier import load_classifier


@pytest.fixture(params=["pipe", "device", "sparse"])
def endless(request):
    """Return what puts a file without an end in a place."""

    def put(path):
        path.unlink(missing_ok=True)
        if request.param == "pipe":
            os.mkfifo(path)
        elif request.param == "device":
            path.symlink_to("/dev/zero")
        else:
            with path.open("wb") as file:
                file.truncate(10**12)

    return put


@pytest.fixture
def run(tmp_path):
    return make_run(tmp_path / "run", "coil", 0, driven("coil", {"a": 1.0, "b": 2.0}))


@pytest.mark.parametrize(
    "name",
    ["config.yaml", "evaluation.csv", "metrics.csv", "guide_return.json"],
)
def test_report_refuses_a_file_without_an_end(run, endless, name):
    assert read_runs([run])[0].finished
    endless(run / name)
    with pytest.raises(UserError, match=name) as caught:
        read_runs([run])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["evaluation.csv", "evaluation.md"])
def test_outcome_of_a_file_without_an_end_is_refused(run, endless, name):
    (run / "evaluation.md").write_text("page")
    assert report_outcome(run) == 1.5
    endless(run / name)
    with pytest.raises(UserError, match="is damaged"):
        report_outcome(run)


def test_resume_refuses_a_file_without_an_end(run, endless, capsys):
    endless(run / "config.yaml")
    with pytest.raises(UserError, match=r"config\.yaml"):
        read_config(run, "resume")
    endless(run / "metrics.csv")
    with pytest.raises(UserError, match=r"metrics\.csv is damaged"):
        Metrics(run / "metrics.csv").truncate(3)
    endless(run / "checkpoint.pt")
    with pytest.raises(UserError, match=r"checkpoint\.pt"):
        checkpoint.load(run / "checkpoint.pt")
    endless(run / "versions.json")
    report_changed_versions(run)
    assert "unknown" in capsys.readouterr().err


def test_guides_and_classifiers_refuse_a_file_without_an_end(tmp_path, endless):
    endless(tmp_path / "file")
    with pytest.raises(ValueError, match="cannot be read"):
        RecordedGuide(tmp_path / "file")
    with pytest.raises(UserError, match="cannot be read"):
        load_classifier(tmp_path / "file")


@pytest.mark.parametrize(
    "node",
    [
        {"_target_": "coil_rl.transforms.DelayedAdvice", "steps": 10**9},
        {"_target_": "coil_rl.learners.Mlp", "hidden": [10**9]},
        {"_target_": "coil_rl.learners.Gru", "state": 10**9},
        {"_target_": "coil_rl.learners.Cnn", "channels": [10**9], "kernels": [1], "strides": [1]},
        {"_target_": "coil_rl.imitation.NetworkRegressor", "hidden": [10**9]},
        {"_target_": "coil_rl.imitation.ForestRegressor", "n_estimators": 10**9},
    ],
    ids=lambda node: node["_target_"].rpartition(".")[2],
)
def test_size_beyond_any_memory_is_refused(node):
    with pytest.raises(UserError, match="at most"):
        build(node, "part")


def test_state_with_a_second_guide_does_not_fit_a_run_with_one():
    one, two = PhaseSchedule(1), PhaseSchedule(2, order="joint")
    with pytest.raises(ValueError, match="numbers of guides here are below 1"):
        one.load_state_dict(two.state_dict())
    two.load_state_dict(two.state_dict())
    assert two.phase.guides == (0, 1)


def test_folder_with_a_pipe_of_any_name_is_read(run):
    os.mkfifo(run / "notes")
    shutil.rmtree(run / "policies", ignore_errors=True)
    assert read_runs([run])[0].finished
