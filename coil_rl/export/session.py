"""The step of an exported policy in onnxruntime."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coil_rl.errors import UserError
from coil_rl.extras import require

Arrays = Mapping[str, NDArray[Any]]


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
        options.log_severity_level = 3
        try:
            self.session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # of many classes, one for each kind of damage
            reason = str(error).splitlines()[0][:200]
            raise UserError(
                f"the policy is no file that onnxruntime can read ({reason}); export it again"
            ) from error
        self.outputs = list(outputs)
        # An input that does not change the result is left out of the file.
        self.read = [each.name for each in self.session.get_inputs()]

    def __call__(self, inputs: Arrays) -> list[NDArray[Any]]:
        """Return the outputs for some rows.

        Args:
            inputs: by name, [B, ...] each; those that the file does not read are left out.
        """
        feeds = {name: np.ascontiguousarray(inputs[name]) for name in self.read}
        results: list[NDArray[Any]] = self.session.run(self.outputs, feeds)
        return results
