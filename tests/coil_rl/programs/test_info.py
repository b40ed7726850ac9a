"""`coil-info`: versions, the command that made a run, and what a policy says about itself."""

import json

import onnx
import pytest
from exported_sums import model, write
from programs import called

from coil_rl.errors import UserError
from coil_rl.export.files import explained
from coil_rl.programs.info import describe, explain


def test_exported_policy_explains_itself(tmp_path):
    path = write(tmp_path) / "policy.onnx"
    contract = json.loads((tmp_path / "contract.json").read_text())
    contract["outputs"][0]["unit"] = "N, m"
    contract["env"]["control_rate"] = {"value": 50.0, "unit": "steps per second"}
    path.write_bytes(explained(model(), contract))
    said = explain(path)
    assert said["observation_names"] == "observation,guide_action"
    assert said["observation_history_lengths"] == "1,1"
    assert (said["action_scale"], said["action_units"]) == ("1.0", "N,m")
    assert said["control_rate"] == "50.0"
    assert said["inputs.observation.shape"] == "[2]"
    assert said["guide.reason"] == "it is Python"
    # The graph is the same, and nothing but the texts makes the file larger.
    bare, whole = onnx.load_from_string(model()), onnx.load(path)
    assert bare.graph == whole.graph
    texts = sum(len(prop.key) + len(prop.value.encode()) for prop in whole.metadata_props)
    assert path.stat().st_size - len(model()) < texts + 200


def test_file_without_words_is_refused(tmp_path):
    path = tmp_path / "policy.onnx"
    path.write_bytes(model())
    with pytest.raises(UserError, match="says nothing about itself"):
        explain(path)
    path.write_bytes(b"no model")
    with pytest.raises(UserError, match="cannot be read as a file of ONNX"):
        explain(path)


def test_damaged_command_is_named(tmp_path):
    (tmp_path / "config.yaml").touch()
    (tmp_path / "command.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(UserError, match=r"command.txt is damaged .*; remove it"):
        describe(tmp_path)


def test_what_a_terminal_obeys_is_shown_as_text(tmp_path):
    (tmp_path / "config.yaml").touch()
    (tmp_path / "command.txt").write_text("coil-train '\x1b]0;title\x07'")
    (tmp_path / "versions.json").write_text(json.dumps({"a\x1b[2J": "\x9b31m\u202e"}))
    done = called("info", f"run={tmp_path}")
    assert r"\x1b]0;title\x07" in done.stdout
    assert r"a\x1b[2J" in done.stdout
    assert r"\x9b31m\u202e" in done.stdout
    gone = called("info", "run=\x1b[2J", code=2)
    assert not {"\x1b", "\x9b", "\x07", "\u202e"} & {*done.stdout, *gone.stderr}
