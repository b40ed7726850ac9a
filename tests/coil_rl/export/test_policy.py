"""An exported policy in onnxruntime: its contract is checked, and so is what it is given."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

import coil_rl
from coil_rl.export.contract import CONTRACT, FORMAT, ONNX, VERSION, checksum
from coil_rl.export.policy import ExportedPolicy

Change = Callable[[dict], None]


def model() -> bytes:
    """Return a file that adds the observation, the advice and what it remembers: their sum."""
    rows = [("observation", 2), ("guide_action", 1), ("state.sum", 1)]
    inputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["b", size]) for name, size in rows
    ]
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["b", 1])
        for name in ("action", "next.sum")
    ]
    axes = helper.make_tensor("axes", TensorProto.INT64, [1], [1])
    nodes = [
        helper.make_node("ReduceSum", ["observation", "axes"], ["total"], keepdims=1),
        helper.make_node("Add", ["total", "guide_action"], ["advised"]),
        helper.make_node("Add", ["advised", "state.sum"], ["action"]),
        helper.make_node("Identity", ["action"], ["next.sum"]),
    ]
    graph = helper.make_graph(nodes, "sum", inputs, outputs, [axes])
    opset = [helper.make_opsetid("", 20)]
    return helper.make_model(graph, opset_imports=opset, ir_version=9).SerializeToString()


def write(folder: Path, change: Change = lambda contract: None) -> Path:
    """Write the file and its contract, perhaps changed, and return the folder."""
    content = model()
    contract = {
        "format": FORMAT,
        "version": VERSION,
        "files": {ONNX: {"sha256": checksum(content), "bytes": len(content)}},
        "env": {"title": "Sum"},
        "inputs": [
            {"name": "observation", "key": ["observation"], "shape": [2], "dtype": "float32"},
            {"name": "guide_action", "key": ["guide_action"], "shape": [1], "dtype": "float32"},
        ],
        "outputs": [
            {
                "name": "action",
                "shape": [1],
                "dtype": "float32",
                "space": {"shape": [1], "dtype": "float64"},
            }
        ],
        "state": [
            {
                "input": "state.sum",
                "output": "next.sum",
                "shape": [1],
                "dtype": "float32",
                "first": 1.0,
            }
        ],
        "guide": {"place": "outside", "names": ["sum"], "reason": "it is Python"},
    }
    change(contract)
    folder.mkdir(exist_ok=True)
    (folder / ONNX).write_bytes(content)
    (folder / CONTRACT).write_text(json.dumps(contract))
    return folder


def test_file_of_the_test_is_valid():
    onnx.checker.check_model(onnx.load_from_string(model()))


def test_state_goes_from_step_to_step_until_a_reset(tmp_path):
    policy = ExportedPolicy(write(tmp_path))
    assert policy.act([2.0, 3.0], 10.0) == 16.0
    assert policy.act({"observation": [0.0, 0.0], "guide_action": [1.0]}) == 17.0
    saved = json.loads(json.dumps(policy.state_dict()))
    assert policy.act([0.0, 0.0], 0.0) == 17.0
    policy.load_state_dict(saved)
    assert policy.act([1.0, 0.0], 0.0) == 18.0
    policy.reset()
    action = policy.act([0.0, 0.0], 0.0)
    assert (action.dtype, action.shape, action[0]) == (np.float64, (1,), 1.0)


@pytest.mark.parametrize(
    ("observation", "advice", "message"),
    [
        ([1.0, 2.0, 3.0], 0.0, r"observation has the shape \[3\], but must have \[2\]"),
        ([1.0, np.nan], 0.0, "observation holds a number that is not finite"),
        (["a", "b"], 0.0, "observation holds <U1, but must hold numbers"),
        ({"other": [1.0, 2.0]}, 0.0, "the observation lacks observation"),
        ([1.0, 2.0], None, "the guide of this policy is outside"),
        ([1.0, 2.0], [1.0, 2.0], r"guide_action has the shape \[2\], but must have \[1\]"),
    ],
)
def test_observation_that_does_not_fit_is_refused(observation, advice, message, tmp_path):
    def names_both(contract):
        contract["inputs"][0]["from"] = {"path": [], "choices": [], "start": []}
        if isinstance(observation, dict):
            contract["inputs"][0]["from"]["path"] = ["observation"]

    policy = ExportedPolicy(write(tmp_path, names_both))
    with pytest.raises(ValueError, match=message):
        policy.act(observation, advice)


def test_choices_are_encoded_as_the_contract_says(tmp_path):
    def of_choices(contract):
        contract["inputs"][0]["from"] = {"path": ["gear"], "choices": [2], "start": [5]}

    policy = ExportedPolicy(write(tmp_path, of_choices))
    assert policy.act({"gear": 6}, 0.0) == 2.0
    with pytest.raises(ValueError, match=r"observation is \[7\], which are no choices of \[2\]"):
        policy.act({"gear": 7}, 0.0)


def test_state_of_another_policy_is_refused(tmp_path):
    policy = ExportedPolicy(write(tmp_path))
    with pytest.raises(ValueError, match="the state has other, but this policy remembers state"):
        policy.load_state_dict({"other": [[1.0]]})


def other_format(contract):
    contract["format"] = "else"


def other_version(contract):
    contract["version"] = VERSION + 1


def without_outputs(contract):
    del contract["outputs"]


def without_checksum(contract):
    del contract["files"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (other_format, "has the format 'else' in version 1"),
        (other_version, "in version 2, but this program reads"),
        (without_outputs, "contract.json is damaged.*outputs.*coil-export run=RUN"),
        (without_checksum, "contract.json is damaged.*files"),
    ],
)
def test_contract_that_cannot_be_used_is_refused(change, message, tmp_path):
    with pytest.raises(coil_rl.UserError, match=message):
        ExportedPolicy(write(tmp_path, change))


@pytest.mark.parametrize("name", [ONNX, CONTRACT])
def test_missing_file_is_named(name, tmp_path):
    write(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(coil_rl.UserError, match=f"{name} does not exist"):
        ExportedPolicy(tmp_path / ONNX)


def test_file_of_another_export_is_refused(tmp_path):
    write(tmp_path)
    (tmp_path / ONNX).write_bytes(model() + b"\0")
    with pytest.raises(coil_rl.UserError, match=r"is not the file that .* is about: its SHA-256"):
        ExportedPolicy(tmp_path)


def test_file_that_is_no_onnx_is_refused(tmp_path):
    write(tmp_path)
    content = b"no model"
    contract = json.loads((tmp_path / CONTRACT).read_text())
    contract["files"][ONNX]["sha256"] = checksum(content)
    (tmp_path / CONTRACT).write_text(json.dumps(contract))
    (tmp_path / ONNX).write_bytes(content)
    with pytest.raises(coil_rl.UserError, match="no file that onnxruntime can read"):
        ExportedPolicy(tmp_path)


def test_missing_package_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr("coil_rl.export.session.find_spec", lambda name: None)
    with pytest.raises(coil_rl.UserError, match=r"onnxruntime: .*pip install 'coil-rl\[export\]'"):
        ExportedPolicy(write(tmp_path))
