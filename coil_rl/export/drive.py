"""Drives by the policy in this folder: copy it, it needs numpy and onnxruntime and nothing else."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime


class Policy:
    """The policy in a folder; call `reset()` at the start of each episode."""

    def __init__(self, folder: Path = Path(__file__).parent) -> None:
        self.contract = json.loads((folder / "contract.json").read_text("utf-8"))
        content = (folder / "policy.onnx").read_bytes()
        if hashlib.sha256(content).hexdigest() != self.contract["files"]["policy.onnx"]["sha256"]:
            raise SystemExit("policy.onnx is not the file that contract.json is about")
        self.session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
        self.read = [each.name for each in self.session.get_inputs()]
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        state = self.contract["state"]
        self.state = {s["input"]: np.full((1, *s["shape"]), s["first"], s["dtype"]) for s in state}

    @np.errstate(all="ignore")  # what a type does not hold is refused
    def act(self, inputs: Any) -> Any:
        """Return the action for the inputs of the contract, by name."""
        feeds = dict(self.state)
        for entry in self.contract["inputs"]:
            given = np.asarray(inputs.get(entry["name"], ()))
            value = feeds[entry["name"]] = given.real[None].astype(entry["dtype"])
            if (
                [*given.shape] != entry["shape"]
                or given.dtype.kind not in "fiub"
                or not np.isfinite(value).all()
                or (value.dtype.kind != "f" and (value != given).any())
            ):
                raise ValueError(
                    f"{entry['name']} must be {entry['shape']} finite numbers of {entry['dtype']}"
                )
            places = given - np.array(entry.get("lowest", given))
            if not ((places >= 0) & (places % 1 == 0) & (places < entry.get("choices", 1))).all():
                raise ValueError(
                    f"{entry['name']} must be numbers of choices, {entry['choices']} from "
                    f"{entry['lowest']} on"
                )
        names = ["action", *(each["output"] for each in self.contract["state"])]
        action, *state = self.session.run(names, {name: feeds[name] for name in self.read})
        self.state = dict(zip(self.state, state, strict=True))
        return action[0]
