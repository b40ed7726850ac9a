"""coil-export, and the programs that take what it wrote."""

import json

import pytest
from omegaconf import OmegaConf
from programs import called

from coil_rl.export.contract import CONTRACT
from coil_rl.export.program import next_step

RUN = "run=pretrained:pendulum/coil"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Return the folder of an exported policy, and what the program printed."""
    folder = tmp_path_factory.mktemp("export") / "pendulum"
    words = ["observations=30", '+meanings.action="torque, N m"', f"hydra.run.dir={folder}"]
    return folder, called("export", RUN, *words).stdout


@pytest.mark.slow
def test_export_prints_what_it_does_and_what_comes_next(exported):
    folder, text = exported
    lines = text.strip().splitlines()
    assert lines[0] == "export: 30 observations of coil in its env ..."
    assert any("the file differs from torch by at most" in line for line in lines)
    assert f"Next: coil-evaluate {RUN} exported={folder}" in lines[-1]
    assert lines[-1].endswith(f"{folder}/drive.py, with numpy and onnxruntime alone")
    assert all(line.startswith("export: ") for line in lines[:-1])  # no notes of libraries


def test_next_step_trusts_what_the_export_trusts_and_is_python_for_a_guide_outside():
    config = OmegaConf.create({"run": "RUN", "run_dir": "folder", "trust": ["mine"]})
    evaluate = "coil-evaluate run=RUN 'trust=[mine]' exported=folder"
    assert next_step(config, "absent") == evaluate
    text = "coil_rl.ExportedPolicy('folder').act(observation, guide_action) in Python"
    assert next_step(config, "outside") == text


@pytest.mark.slow
def test_contract_says_what_the_numbers_mean(exported):
    folder, _ = exported
    contract = json.loads((folder / CONTRACT).read_text("utf-8"))
    (observation,) = contract["inputs"]
    assert (observation["shape"], observation["dtype"]) == ([3], "float32")
    assert observation["bounds"] == {"low": [-1.0, -1.0, -8.0], "high": [1.0, 1.0, 8.0]}
    (action,) = contract["outputs"]
    assert action["meaning"] == "torque, N m"
    assert action["bounds"] == {"low": [-2.0], "high": [2.0]}
    assert contract["env"]["control_rate"]["value"] == 30
    guide = contract["guide"]
    assert (guide["place"], guide["names"]) == ("inside", ["swing_up"])
    assert guide["settings"]["swing_up"]["controller"] == "swing_up"
    assert any("scale of the action" in sentence for sentence in contract["inside"])
    assert [row["driver"] for row in contract["results"]] == ["guide", "coil", "coil"]
    assert contract["parity"]["largest_difference"] < 2e-5
    assert str(folder) not in json.dumps(contract)


@pytest.mark.slow
def test_evaluation_of_the_file_is_that_of_the_policy(exported, tmp_path):
    folder, _ = exported

    def reward(name, *words):
        words = [RUN, "evaluation.cases=3", f"hydra.run.dir={tmp_path / name}", *words]
        last = called("evaluate", *words).stdout.splitlines()[-1]
        return last.partition("mean test reward ")[2].partition(";")[0]

    assert reward("file", f"exported={folder}") == reward("run") != ""


@pytest.mark.slow
def test_file_is_a_guide_of_its_env_only(exported, tmp_path):
    folder, _ = exported
    words = ["guide=exported", f"guide.exported.file={folder}"]
    words.append(f"hydra.run.dir={tmp_path / 'results'}")
    done = called("evaluate", "env=pendulum", "evaluation.cases=2", *words)
    assert "mean test reward" in done.stdout
    for others in (["env=mountain_car", "evaluation.cases=2"], []):
        done = called("evaluate", *others, *words, code=2)
        assert "is a policy for Pendulum-v1, which this env is not" in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run=nowhere"], "nowhere is not the folder of a run"),
        (["run=pretrained:nothing"], "pretrained:nothing does not exist; there are"),
        ([RUN, "policy=first"], "policy"),
        ([RUN, "observations=0"], "observations"),
        ([RUN, "+meanings.action={size: 3}"], "must be a text, or a mapping with some of unit"),
        ([RUN, "policy=best"], "policy='best' must be 'handed_over' or 'last'"),
        ([], "run must be given: write run=VALUE"),
    ],
)
def test_mistake_is_one_sentence(words, message, tmp_path):
    folder = tmp_path / "exported"
    done = called("export", *words, f"hydra.run.dir={folder}", code=2)
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not folder.exists()


def test_exported_file_needs_its_run(tmp_path):
    words = ["exported=policy.onnx", f"hydra.run.dir={tmp_path / 'results'}"]
    done = called("evaluate", *words, code=2)
    assert "exported=policy.onnx needs the run whose env it is evaluated in" in done.stderr
