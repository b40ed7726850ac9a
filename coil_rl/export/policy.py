"""An exported policy as a controller: onnxruntime and the contract, without PyTorch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coil_rl.export.contract import ADVICE, ONNX, read_contract
from coil_rl.export.session import Session
from coil_rl.foreign.faults import shown


class ExportedPolicy:
    """A policy in a file, with the methods of `Controller`.

    Actions are deterministic. Call `reset()` at the start of each episode.

    Args:
        file: `policy.onnx` of `coil-export`, or its folder.
        threads: of onnxruntime.

    Attributes:
        contract: what the numbers mean, see docs/export.md.

    Raises:
        UserError: without onnxruntime, for a file that is missing or damaged, and for one that is
            not the one of its contract.

    Example:
        >>> from coil_rl.export import ExportedPolicy
        >>> policy = ExportedPolicy("exported")  # doctest: +SKIP
        >>> policy.reset()  # doctest: +SKIP
        >>> action = policy.act(observation)  # doctest: +SKIP
    """

    def __init__(self, file: str | Path, threads: int = 1) -> None:
        path = Path(file).expanduser()
        self.file = path / ONNX if path.is_dir() else path
        self.contract, content = read_contract(self.file)
        names = ["action", *(entry["output"] for entry in self.contract["state"])]
        self.session = Session(content, names, threads)
        self.session.check(self.contract)
        self.reset()

    def reset(self) -> None:
        """Begin an episode: forget everything."""
        self.state = self.first_state()

    def first_state(self) -> dict[str, NDArray[Any]]:
        """Return what the policy remembers at the start of an episode, by input, [1, ...] each."""
        return {
            entry["input"]: np.full((1, *entry["shape"]), entry["first"], entry["dtype"])
            for entry in self.contract["state"]
        }

    def act(self, observation: Any, guide_action: Any = None) -> Any:
        """Return the action for an observation.

        Args:
            observation: as the env gives it: for a Gymnasium env what its `reset` and `step`
                return; for a TorchRL env its entries as a mapping, or the value of the only entry.
            guide_action: what the guides advise in the unit and numbering of the env, where the
                contract says that they are outside: [guides, A] as in the contract, the action of
                the only guide as the env takes it, or, for an env with one agent, these of all
                guides, [guides, *shape].

        Returns:
            The action in the unit and numbering of the env: for a Gymnasium env what its `step`
            takes; for a TorchRL env an array.

        Raises:
            ValueError: for an observation that does not fit the contract, and for a `guide_action`
                where no guide is outside.
        """
        place = self.contract["guide"]["place"]
        if guide_action is not None and place != "outside":
            raise ValueError(
                f"this policy takes no guide_action: its guide is {place}; leave guide_action out"
            )
        names = {entry["name"] for entry in self.contract["inputs"]}
        feeds, only = dict(self.state), len(names - {ADVICE}) == 1
        for entry in self.contract["inputs"]:
            if entry["name"] == ADVICE:
                value = self._in_rows(_advice(observation, guide_action), entry["shape"])
            else:
                value = _found(observation, entry, only=only)
            feeds[entry["name"]] = _row(value, entry)
        action, *state = self.session(feeds)
        self.state = dict(zip(self.state, state, strict=True))
        space = self.contract["outputs"][0]["space"]
        return action[0].reshape(space["shape"]).astype(space["dtype"])[()]

    def _in_rows(self, advice: Any, rows: Sequence[int]) -> Any:
        """Return actions in the shape that the env takes as rows of the contract, others as given.

        Args:
            advice: actions of the guides.
            rows: shape in the contract, [*agents, guides, A].
        """
        given, guides = np.asarray(advice), len(self.contract["guide"]["names"])
        own = tuple(self.contract["outputs"][0]["space"]["shape"])
        taken = [own] if guides == 1 else []
        if len(rows) <= 2:  # with several agents the guides are not the first dimension
            taken.append((guides, *own))
        if given.shape in taken and given.size == np.prod(rows, dtype=int):
            return given.reshape(rows)
        return advice

    def state_dict(self) -> dict[str, Any]:
        """Return what the next actions of the episode depend on, besides their observations."""
        return {name: value.tolist() for name, value in self.state.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            ValueError: for the state of another policy.
        """
        first = self.first_state()
        given = {name: np.shape(value) for name, value in state.items()}
        if given != {name: value.shape for name, value in first.items()}:
            names = ", ".join(first) or "nothing"
            raise ValueError(
                f"the state has {', '.join(state) or 'nothing'}, but this policy remembers "
                f"{names}; restore the state of the same policy"
            )
        self.state = {name: np.asarray(state[name], first[name].dtype) for name in first}


def _advice(observation: Any, guide_action: Any) -> Any:
    if guide_action is None and isinstance(observation, Mapping):
        guide_action = observation.get(ADVICE)
    if guide_action is None:
        raise ValueError(
            "the guide of this policy is outside: give its action as guide_action, in the unit and "
            "numbering of the env"
        )
    return guide_action


def _found(observation: Any, entry: Mapping[str, Any], *, only: bool) -> Any:
    """Return the part of an observation that an input of the contract stands for.

    Args:
        only: whether there is no other one.
    """
    source, path = entry.get("from"), entry["key"]
    if source is not None:
        # The entry itself may be given too, as by a guide of another run.
        named = isinstance(observation, Mapping) and entry["key"][0] in observation
        if source["path"] or not named:
            path = source["path"]
    elif only and not isinstance(observation, Mapping):
        path = []
    try:
        found = reduce(getitem, path, observation)
    except (IndexError, KeyError, TypeError):
        found = {}
    if isinstance(found, Mapping):
        raise ValueError(
            f"the observation lacks {entry['name']}; the policy reads it, see its contract.json"
        )
    if source is not None and source["choices"]:
        return _one_hot(found, entry)
    return found


def _one_hot(value: Any, entry: Mapping[str, Any]) -> Any:
    """Return choices as one-hot vectors side by side, unless they are that already."""
    source = entry["from"]
    sizes, given = np.array(source["choices"]), np.asarray(value)
    if given.size == sizes.sum() and given.size != sizes.size:
        return given
    chosen = _chosen(entry["name"], np.ravel(given), source["choices"], source["start"])
    vector = np.zeros(sizes.sum())
    vector[chosen + np.cumsum([0, *sizes[:-1]])] = 1
    return vector


def _row(value: Any, entry: Mapping[str, Any]) -> NDArray[Any]:
    """Return the value of an input with the batch dimension, [1, ...]."""
    given, shape = np.asarray(value), tuple(entry["shape"])
    # Dimensions of 1 may be left out.
    fits = [n for n in given.shape if n != 1] == [n for n in shape if n != 1]
    if fits and given.dtype.kind in "fiub":
        with np.errstate(all="ignore"):
            converted = given.astype(entry["dtype"])
        same = converted.dtype.kind == "f" or (converted == given).all()
        if same and np.isfinite(converted).all():
            if "choices" in entry:
                _chosen(entry["name"], given.reshape(shape), entry["choices"], entry["lowest"])
            return converted.reshape(1, *shape)
    raise ValueError(
        f"{entry['name']} is {shown(value)}, but must be {list(shape)} finite numbers of "
        f"{entry['dtype']}"
    )


def _chosen(
    name: str, given: NDArray[Any], choices: Sequence[int], lowest: Sequence[int]
) -> NDArray[np.int64]:
    """Return numbers of choices, counted from 0.

    Args:
        given: numbers as the env counts them, [..., n].
        choices: how many there are of each, [n].
        lowest: number of the first one of each, [n].

    Raises:
        ValueError: for anything but numbers of choices.
    """
    places = given - np.array(lowest) if given.shape[-1:] == (len(choices),) else np.array(-1)
    if not ((places >= 0) & (places % 1 == 0) & (places < np.array(choices))).all():
        raise ValueError(
            f"{name} is {given.tolist()}, which are no choices of {list(choices)} from "
            f"{list(lowest)} on"
        )
    return places.astype(np.int64)
