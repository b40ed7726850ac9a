"""What the contract of an exported policy says: gathered from run, env and comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping
from importlib import metadata
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from tensordict import unravel_key
from torchrl.data import Bounded

from coil_rl import record
from coil_rl.envs.meanings import meaning, meanings_of
from coil_rl.export.contract import ADVICE, FORMAT, VERSION
from coil_rl.export.files import OPSET
from coil_rl.export.parity import Parity
from coil_rl.export.step import Entry, PolicyStep
from coil_rl.foreign.gymnasium_env import GymnasiumEnv
from coil_rl.guides.simple import FollowAdvice
from coil_rl.learners.normaliser import Normaliser
from coil_rl.measures import MEAN_CASE
from coil_rl.report.runs import GUIDE
from coil_rl.run.controller import Controller
from coil_rl.run.delivery import GuideActs
from coil_rl.run.folder import HANDED_OVER
from coil_rl.run.reasons import FIRST, handed_over
from coil_rl.run.run import Run

PACKAGES = ("coil-rl", "torch", "onnx", "onnxscript", "onnxruntime")
LEARNED = "a learned policy"
AS_GIVEN = "as the env gives it"
EACH_EPISODE = (
    "In the first step of each episode every state input is its `first` value; afterwards it is "
    "what the step before gave as the output beside it."
)


def describe(
    run: Run,
    controller: Controller,
    step: PolicyStep,
    parity: Parity,
    *,
    which: str,
    outside: str | None,
    meanings: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the contract of an exported policy, but for its `files`.

    Args:
        which: policy of the run, "handed_over" or "last".
        outside: why the guides are outside; None if they are not.
        meanings: of entries, in place of what the env says, see `coil_rl.envs.meanings`.
    """
    plant = controller.plant
    known = meanings_of(plant)
    title = plant.codec.name if isinstance(plant, GymnasiumEnv) else type(plant).__name__
    rate: dict[str, Any] | None = None
    if not math.isnan(getattr(plant, "rate", math.nan)):
        rate = {"value": float(plant.rate), "unit": "steps per second"}
    for name, value in meanings.items():
        known[name] = known.get(name, {}) | meaning(name, value)
    return {
        "format": FORMAT,
        "version": VERSION,
        "policy": _policy(run, which, guide_itself(controller, step)),
        "env": {"title": title, "control_rate": rate},
        "batch": "any number of rows; the first dimension of every input and output",
        "inputs": [_input(entry, plant, step, known) for entry in step.inputs],
        "outputs": [_action(plant, step, known)],
        "state": [_state(entry) for entry in step.state],
        "reset": EACH_EPISODE if step.state else "The policy remembers nothing between two steps.",
        "guide": _guide(run, step, outside),
        "inside": _inside(step),
        "parity": {
            "observations": parity.observations,
            "largest_difference": parity.largest,
            "limit": parity.limit,
            "unit": "normalised actions: 1 is half of the range of a number; another choice is 1",
            "cpu_milliseconds_per_call": round(parity.milliseconds, 3),
            "cpu_milliseconds_per_call_of_torch": round(parity.torch_milliseconds, 3),
        },
        "results": results_of(run, which),
        "made_with": {name: metadata.version(name) for name in PACKAGES} | {"opset": OPSET},
    }


def guide_itself(controller: Controller, step: PolicyStep) -> str | None:
    """Return the name of the guide that acts in place of a learned policy; None for a policy.

    A run may have handed over its guide, see `coil_rl.run.delivery`, or have no other policy.
    """
    policy = controller.policy
    if isinstance(policy, GuideActs):
        policy = policy.advised
    return step.guides[int(policy.guide)] if isinstance(policy, FollowAdvice) else None


def _policy(run: Run, which: str, guide: str | None) -> dict[str, Any]:
    tested = which == HANDED_OVER and run.delivery == "tested"  # so a test may have chosen it
    delivery = record.DELIVERY.read(run.folder) if tested else None
    said = handed_over(run.folder) if tested else []
    method = run.settings.get("method") or {}
    acts = LEARNED
    if guide is not None:
        acts = f"guide {guide} itself, not a learned policy"
    elif delivery is not None and delivery.policy == FIRST:
        acts = "the first policy, which is its guide and has learned nothing"
    return {
        "label": run.label,
        "method": method.get("name", run.label),
        "seed": run.seed,
        "frames": run.budget.frames,
        "which": which,
        "chosen": " ".join(said) or "the last policy of the training",
        "acts": acts,
        "actions": "deterministic",
    }


def _numbers(values: Any) -> Any:
    """Return numbers as nested lists, None for those that are not finite."""
    numbers = np.asarray(values)
    return np.where(np.isfinite(numbers), numbers, None).tolist()  # type: ignore[call-overload]


def _bounds(spec: Any, batch_dims: int) -> dict[str, Any] | None:
    if not isinstance(spec, Bounded):
        return None
    first = (0,) * batch_dims
    return {"low": _numbers(spec.space.low[first]), "high": _numbers(spec.space.high[first])}


def _input(
    entry: Entry, plant: Any, step: PolicyStep, known: Mapping[str, Mapping[str, str]]
) -> dict[str, Any]:
    key = [entry.key] if isinstance(entry.key, str) else list(entry.key)
    about: dict[str, Any] = {"name": entry.name, "key": key, "shape": list(entry.shape)}
    about["dtype"] = _name(entry.dtype)
    if entry.key == ADVICE:
        unit = known.get("action", {}).get("unit", AS_GIVEN)
        return about | {
            "unit": unit if step.space.continuous else "number of a choice",
            "meaning": "the actions of the guides, in the unit and numbering of the env, in this "
            f"order: {', '.join(step.guides)}",
            **_numbering(step),
        }
    about["bounds"] = _bounds(plant.observation_spec[entry.key], plant.batch_dims)
    if isinstance(plant, GymnasiumEnv):
        about |= _source(plant, entry)
    return about | {"unit": AS_GIVEN, "meaning": AS_GIVEN} | dict(known.get(entry.name, {}))


def _source(plant: GymnasiumEnv, given: Entry) -> dict[str, Any]:
    """Return where an input is in the observation of a Gymnasium env."""
    entry = {each.key: each for each in plant.codec.entries}.get(unravel_key(given.key))
    if entry is None:  # an entry beside the observation, such as the action of a controller
        return {}
    start = entry.lowest.expand(len(entry.choices)) if entry.choices else entry.lowest[:0]
    source = {"path": list(entry.path), "choices": entry.choices, "start": start.tolist()}
    about: dict[str, Any] = {"from": source}
    if entry.choices:
        about["encoding"] = "one-hot vectors of the choices side by side"
    elif isinstance(entry.space, spaces.Box) and entry.space.is_bounded():
        low, high = _numbers(entry.space.low), _numbers(entry.space.high)
        about["bounds"] = {"low": low, "high": high}
    return about


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _action(plant: Any, step: PolicyStep, known: Mapping[str, Mapping[str, str]]) -> dict[str, Any]:
    """Return what the output is."""
    spec = plant.full_action_spec[plant.action_key]
    about = {"shape": list(spec.shape[plant.batch_dims :]), "dtype": _name(spec.dtype)}
    space = about
    if isinstance(plant, GymnasiumEnv):
        own = plant.codec.actions.space
        space = {"shape": list(own.shape or ()), "dtype": str(own.dtype)}
    numbers = _numbering(step) or {"bounds": _bounds(spec, plant.batch_dims)}
    unit = "number of a choice" if step.space.choices else AS_GIVEN
    meant = {"unit": unit, "meaning": "the action that the env executes"}
    meant |= known.get("action", {})
    return {"name": "action", **about, **meant, **numbers, "space": space}


def _numbering(step: PolicyStep) -> dict[str, Any]:
    """Return the numbers of choices, and the lowest number of each; nothing without choices."""
    if not step.space.choices:
        return {}
    first = step.space.first
    lowest = [0] * len(step.space.choices) if first is None else first.reshape(-1).tolist()
    return {"choices": step.space.choices, "lowest": lowest}


def _state(entry: Entry) -> dict[str, Any]:
    """Return what a state input is; a first value that is one number is written as one."""
    first = torch.zeros(()) if entry.first is None else entry.first
    one = bool((first == first.reshape(-1)[0]).all())
    return {
        "input": f"state.{entry.name}",
        "output": f"next.{entry.name}",
        "shape": list(entry.shape),
        "dtype": _name(entry.dtype),
        "first": first.reshape(-1)[0].item() if one else first.tolist(),
    }


def _guide(run: Run, step: PolicyStep, outside: str | None) -> dict[str, Any]:
    if not step.guides:
        return {"place": "absent"}
    given, tuned = run.settings.get("guide") or {}, record.TUNED.read(run.folder)
    settings = {name: given[name] for name in step.guides if name in given}
    about = {"names": step.guides, "settings": settings} | ({"tuned": tuned} if tuned else {})
    if outside is None:
        return {"place": "inside", **about}
    return {"place": "outside", **about, "key": ADVICE, "reason": outside}


def _inside(step: PolicyStep) -> list[str]:
    """Return sentences that say what the file does, which nobody must do again."""
    sentences = []
    for module in step.modules():
        if isinstance(module, Normaliser):
            names = [key if isinstance(key, str) else ".".join(key) for key in module.in_keys]
            sentences.append(f"the normalisation of {', '.join(names)}: give them as they are")
    units = step.space.units
    if units is not None and not units.identity:
        sentences.append("the scale of the action: the output is in the unit of the env")
    if step.space.first is not None:
        sentences.append("the lowest numbers of the choices: the output is what the env takes")
    if step.guides and ADVICE not in [entry.key for entry in step.inputs]:
        sentences.append(f"the guides: {', '.join(step.guides)}")
    if step.state:
        sentences.append("the memory, which goes in and out as state")
    return sentences


def results_of(run: Run, which: str) -> list[dict[str, Any]]:
    """Return the means of the evaluation of a run, by driver; empty if it was not evaluated.

    They are of the policy that it handed over; of another one only the guides have results.

    Args:
        which: as for `describe`.
    """
    rows = record.EVALUATION.read(run.folder) or []
    delivery = record.DELIVERY.read(run.folder)
    if which == "last" and delivery and "last" in delivery.returns and delivery.policy != "last":
        rows = [row for row in rows if row["driver"].split()[0] == GUIDE]
    cases = len({row["case"] for row in rows} - {MEAN_CASE})
    results = []
    for row in rows:
        if row["case"] == MEAN_CASE:
            said = {name: row[name] for name in ("driver", "advice", "actions")} | {"cases": cases}
            numbers = {name: row[name] for name in row if name not in record.DRIVER}
            results.append(said | {name: _numbers(each) for name, each in numbers.items()})
    return results
