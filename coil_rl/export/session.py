"""The step of an exported policy in onnxruntime."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coil_rl.errors import UserError
from coil_rl.extras import require

Arrays = Mapping[str, NDArray[Any]]
LARGEST_MEMORY = 2**31  # bytes, of what all files of a process compute
TYPES = {"tensor(float)": "float32", "tensor(double)": "float64", "tensor(float16)": "float16"}


class Session:
    """A file of ONNX that is called step by step, on the CPU.

    Args:
        content: of the file.
        outputs: names of the outputs in their order.
        threads: of onnxruntime.

    Raises:
        UserError: without onnxruntime, or if it cannot read the file.
    """

    def __init__(self, content: bytes, outputs: Sequence[str], threads: int = 1) -> None:
        require("an exported policy", "export", "onnxruntime")
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        options.log_severity_level = 4
        _limit_memory()
        options.add_session_config_entry("session.use_env_allocators", "1")
        try:
            self.session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # of many classes, one for each kind of damage
            raise UserError(
                f"the policy is no file that onnxruntime can read ({_first_line(error)}); export "
                "it again"
            ) from error
        self.outputs, self.shapes = list(outputs), dict[str, list[int]]()  # of a checked file
        # An input that does not change the result is left out of the file.
        self.read = [each.name for each in self.session.get_inputs()]

    def check(self, contract: Mapping[str, Any]) -> None:
        """Check the file, and what it writes from here on, by its contract.

        Args:
            contract: read and checked, see `read_contract`.

        Raises:
            UserError: if the file has other inputs or outputs.
        """
        state = contract["state"]
        inputs = {entry["name"]: entry for entry in contract["inputs"]}
        inputs |= {entry["input"]: entry for entry in state}
        self.shapes = {"action": contract["outputs"][0]["shape"]}
        self.shapes |= {entry["output"]: entry["shape"] for entry in state}
        for each in self.session.get_inputs():
            self._check(each, inputs, "reads")
        written = {each.name: each for each in self.session.get_outputs()}
        for name, shape in self.shapes.items():
            if name not in written:
                raise _unfit(f"it writes no {name}")
            self._check(written[name], {name: {"shape": shape}}, "writes")

    def _check(self, each: Any, entries: Mapping[str, Any], verb: str) -> None:
        """Raise a `UserError` for an input or output of the file that the contract has not."""
        if each.name not in entries:
            raise _unfit(f"it {verb} {each.name:.100}, which the contract has not")
        entry, own = entries[each.name], [*each.shape]
        sizes = [size if isinstance(size, int) else None for size in own]
        fits = len(own) == len(entry["shape"]) + 1 and all(
            size in (None, given) for size, given in zip(sizes[1:], entry["shape"], strict=True)
        )
        if not fits or sizes[0] is not None:
            raise _unfit(f"it {verb} {each.name} {own}, not any rows of {entry['shape']}")
        kind = TYPES.get(each.type, each.type.removeprefix("tensor(").removesuffix(")"))
        if entry.get("dtype", kind) != kind:
            raise _unfit(f"it {verb} {each.name} as {kind}, not {entry['dtype']}")

    def __call__(self, inputs: Arrays) -> list[NDArray[Any]]:
        """Return the outputs for some rows.

        Args:
            inputs: by name, [B, ...] each; those that the file does not read are left out.

        Raises:
            UserError: for what onnxruntime raises, and for outputs of another shape.
        """
        feeds = {name: np.ascontiguousarray(inputs[name]) for name in self.read}
        rows = len(next(iter(inputs.values())))
        try:
            results: list[NDArray[Any]] = self.session.run(self.outputs, feeds)
        except Exception as error:  # of many classes
            raise _unfit(f"it fails with {_first_line(error)}") from error
        for (name, shape), value in zip(self.shapes.items(), results, strict=False):
            if value.shape != (rows, *shape):
                raise _unfit(
                    f"it wrote {name} {list(value.shape)} for {rows} rows, not {[rows, *shape]}"
                )
        return results


@cache
def _limit_memory() -> None:
    """Limit the shared allocator of onnxruntime, for sessions that use it, to `LARGEST_MEMORY`."""
    import onnxruntime as ort

    kind = ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR
    place = ort.OrtMemoryInfo("Cpu", kind, 0, ort.OrtMemType.DEFAULT)
    ort.create_and_register_allocator(place, ort.OrtArenaCfg({"max_mem": LARGEST_MEMORY}))


def _unfit(problem: str) -> UserError:
    return UserError(f"the policy is not what its contract.json says: {problem}; export it again")


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
