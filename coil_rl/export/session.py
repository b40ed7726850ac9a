"""The step of an exported policy in onnxruntime."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coil_rl.errors import UserError
from coil_rl.extras import require
from coil_rl.foreign.faults import shortened

Arrays = Mapping[str, NDArray[Any]]
LARGEST_MEMORY = 2**31  # bytes, of what all files of a process compute
ROWS = 3  # of a first call: a file for one row only is none


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
                f"the policy is no file that onnxruntime can read ({shortened(str(error))}); "
                "export it again"
            ) from error
        self.outputs, self.shapes = list(outputs), dict[str, list[int]]()  # of a checked file
        # An input that does not change the result is left out of the file.
        self.read = [each.name for each in self.session.get_inputs()]

    def check(self, contract: Mapping[str, Any]) -> None:
        """Call the file as its contract says, and check what it writes from here on.

        Args:
            contract: read and checked, see `read_contract`.

        Raises:
            UserError: if the file has other inputs or outputs.
        """
        state = contract["state"]
        read = {entry["name"]: entry for entry in contract["inputs"]}
        read |= {entry["input"]: entry for entry in state}
        self.shapes = {"action": contract["outputs"][0]["shape"]}
        self.shapes |= {entry["output"]: entry["shape"] for entry in state}
        self({name: np.zeros((ROWS, *each["shape"]), each["dtype"]) for name, each in read.items()})

    def __call__(self, inputs: Arrays) -> list[NDArray[Any]]:
        """Return the outputs for some rows.

        Args:
            inputs: by name, [B, ...] each; those that the file does not read are left out.

        Raises:
            UserError: for what onnxruntime raises, and for outputs of another shape.
        """
        feeds = {name: np.ascontiguousarray(inputs[name]) for name in self.read if name in inputs}
        rows = len(next(iter(inputs.values())))
        try:
            results: list[NDArray[Any]] = self.session.run(self.outputs, feeds)
        except Exception as error:  # of many classes
            raise _unfit(f"it fails with {shortened(str(error))}") from error
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
