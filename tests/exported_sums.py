"""A small exported policy, made by hand: the sum of all its inputs."""

import json
from collections.abc import Callable
from pathlib import Path

from onnx import TensorProto, helper

from coil_rl.export.contract import CONTRACT, FORMAT, ONNX, VERSION, checksum

Change = Callable[[dict], None]


def model(
    advised: bool = True, batch: str | int = "b", seen: str = "observation", zeros: int = 1
) -> bytes:
    """Return a file that adds the observation, the advice and what it remembers: their sum.

    Args:
        zeros: how many of them it adds, too.
    """
    rows = [(seen, 2), *([("guide_action", 1)] if advised else []), ("state.sum", 1)]
    inputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [batch, size]) for name, size in rows
    ]
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["b", 1])
        for name in ("action", "next.sum")
    ]
    axes = helper.make_tensor("axes", TensorProto.INT64, [1], [1])
    nodes = [
        helper.make_node("ReduceSum", [seen, "axes"], ["total"], keepdims=1),
        helper.make_node("Add", ["total", "guide_action" if advised else "total"], ["advised"]),
        helper.make_node("ConstantOfShape", ["zeros"], ["nothing"]),
        helper.make_node("ReduceSum", ["nothing"], ["zero"], keepdims=0),
        helper.make_node("Sum", ["advised", "state.sum", "zero"], ["action"]),
        helper.make_node("Identity", ["action"], ["next.sum"]),
    ]
    size = helper.make_tensor("zeros", TensorProto.INT64, [1], [zeros])
    graph = helper.make_graph(nodes, "sum", inputs, outputs, [axes, size])
    opset = [helper.make_opsetid("", 20)]
    return helper.make_model(graph, opset_imports=opset, ir_version=9).SerializeToString()


def write(folder: Path, change: Change = lambda contract: None, content: bytes = b"") -> Path:
    """Write the file and its contract, perhaps changed, and return the folder."""
    content, one = content or model(), {"shape": [1], "dtype": "float32"}
    contract = {
        "format": FORMAT,
        "version": VERSION,
        "files": {ONNX: {"sha256": checksum(content), "bytes": len(content)}},
        "env": {"title": "Sum"},
        "inputs": [
            {"name": "observation", "key": ["observation"], "shape": [2], "dtype": "float32"},
            {"name": "guide_action", "key": ["guide_action"], **one},
        ],
        "outputs": [{"name": "action", **one, "space": {"shape": [1], "dtype": "float64"}}],
        "state": [{"input": "state.sum", "output": "next.sum", **one, "first": 1.0}],
        "guide": {"place": "outside", "names": ["sum"], "reason": "it is Python"},
    }
    change(contract)
    folder.mkdir(exist_ok=True)
    (folder / ONNX).write_bytes(content)
    (folder / CONTRACT).write_text(json.dumps(contract, ensure_ascii=False), "utf-8")
    return folder
