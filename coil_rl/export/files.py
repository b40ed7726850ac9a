"""A function of tensors as files of ONNX and of torch.export, without traces of this machine."""

from __future__ import annotations

import io
import json
import logging
import math
import textwrap
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any

import torch
from torch.export import Dim, ExportedProgram
from torchrl.envs import ExplorationType, set_exploration_type

from coil_rl.export.step import NotExportableError, PolicyStep
from coil_rl.foreign.guard import Guard

OPSET = 20
ROWS = 3  # of the example with which a step is traced
TRACES = ("stack_trace", "nn_module_stack", "source_fn_stack", "from_node", "torch_fn", "custom")


def names_of(step: PolicyStep) -> tuple[list[str], list[str]]:
    """Return the names of the inputs and of the outputs of the files."""
    inputs = [entry.name for entry in step.inputs]
    inputs += [f"state.{entry.name}" for entry in step.state]
    return inputs, ["action", *(f"next.{entry.name}" for entry in step.state)]


def traced(step: PolicyStep) -> ExportedProgram:
    """Return a step as the program of torch.export, for any number of rows.

    Raises:
        NotExportableError: for a step that is no function of tensors.
    """
    entries = [*step.inputs, *step.state]
    if not entries:
        raise NotExportableError("it reads nothing, so there is nothing to export")
    batch = Dim("batch", min=1)
    examples = tuple(entry.rows(ROWS) for entry in entries)
    shapes = {"tensors": tuple({0: batch} for _ in entries)}
    try:
        with _quiet(), torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            program = torch.export.export(step, examples, dynamic_shapes=shapes)
    except NotExportableError:
        raise
    except Exception as error:  # whatever the modules raise that see no real numbers
        raise NotExportableError(_reason(error)) from error
    for node in program.graph.nodes:
        for name in TRACES:
            node.meta.pop(name, None)
    return program


def as_torch(program: ExportedProgram) -> bytes:
    """Return the content of a file that `torch.export.load` reads."""
    file = io.BytesIO()
    with _quiet():
        torch.export.save(program, file)
    return file.getvalue()


def as_onnx(program: ExportedProgram, step: PolicyStep) -> bytes:
    """Return the content of a file of ONNX.

    Args:
        step: what was traced, for the names of inputs and outputs.

    Raises:
        NotExportableError: for an operation that ONNX does not have.
    """
    inputs, outputs = names_of(step)
    try:
        with _quiet():
            written = torch.onnx.export(
                program,
                (),
                dynamo=True,
                opset_version=OPSET,
                input_names=inputs,
                output_names=outputs,
                verbose=False,
                # Its search for patterns takes a minute for a guide; see `_smaller`.
                optimize=False,
            )
    except Exception as error:  # of many classes, one for each step of the translation
        raise NotExportableError(_reason(error)) from error
    if written is None:
        raise NotExportableError("torch.onnx gave no program")
    with _quiet():
        return _smaller(written.model)


def _smaller(model: Any) -> bytes:
    """Return the content of a file: constants folded, unused parts and texts left out.

    Args:
        model: as `onnx_ir` has it.
    """
    import onnx_ir
    from onnx_ir.passes import common
    from onnxscript.optimizer import fold_constants_ir

    fold_constants_ir(model)
    for each in (
        common.CommonSubexpressionEliminationPass(),
        common.RemoveUnusedNodesPass(),
        common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        common.DeduplicateInitializersPass(),
        common.RemoveUnusedNodesPass(),
        common.ClearMetadataAndDocStringPass(),
    ):
        each(model)
    proto = onnx_ir.serde.serialize_model(model)
    # Stack traces with the paths of this machine are there, too.
    del proto.metadata_props[:], proto.graph.metadata_props[:], proto.graph.value_info[:]
    for part in (*proto.graph.node, *proto.graph.input, *proto.graph.output):
        del part.metadata_props[:]
    for part in proto.graph.initializer:
        del part.metadata_props[:]
    content: bytes = proto.SerializeToString()
    return content


def explained(content: bytes, contract: Mapping[str, Any]) -> bytes:
    """Return the content of a file of ONNX that says what its numbers mean, as metadata.

    Its entry `contract` is all of that as JSON. The others are lists with commas that programs of
    robots read. Their scales are 1, because inputs and action are in the units of the env, and so
    are the lengths of the history, because an input is of the present step.

    Args:
        contract: without its `files`, among which is this one.
    """
    import onnx

    names = [entry["name"] for entry in contract["inputs"]]
    (output,) = contract["outputs"]
    said = {
        "observation_names": names,
        "observation_scales": [1.0] * len(names),
        "observation_history_lengths": [1] * len(names),
        "action_scale": [1.0] * math.prod(output["shape"]),
        "action_units": str(output["unit"]).split(", "),
    }
    if rate := contract["env"]["control_rate"]:
        said["control_rate"] = [rate["value"]]
    texts = {key: ",".join(map(str, values)) for key, values in said.items()}
    texts["contract"] = json.dumps(contract, ensure_ascii=False, allow_nan=False)
    model = onnx.load_from_string(content)
    onnx.helper.set_model_props(model, texts)
    written: bytes = model.SerializeToString()
    return written


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence what the libraries say about themselves in the block, and undo what they set."""
    with (
        Guard(),
        warnings.catch_warnings(),
        redirect_stdout(io.StringIO()),
        redirect_stderr(io.StringIO()),
    ):
        logging.disable(logging.WARNING)
        warnings.simplefilter("ignore")
        yield


def _reason(error: BaseException) -> str:
    """Return in a few words what a library says about a function that it cannot write."""
    if "data-dependent" in str(error):
        return "what it does depends on the values of its numbers, as an `if` on a tensor does"
    if "Constraints violated" in str(error):
        return "it takes one number of rows only, not any"
    lines = str(error).strip().splitlines() or [""]
    return textwrap.shorten(f"{type(error).__name__}: {lines[0]}", 200, placeholder=" ...")
