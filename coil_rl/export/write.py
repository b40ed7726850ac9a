"""Export of the policy of a run: recorded, traced, written, compared, described."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from coil_rl.errors import UserError
from coil_rl.export.contract import CONTRACT, DRIVER, ONNX, TORCH, checksum
from coil_rl.export.describe import LEARNED, describe
from coil_rl.export.files import as_onnx, as_torch, explained, traced
from coil_rl.export.parity import LIMIT, WITH_GUIDE, Parity, Step, compare, record
from coil_rl.export.policy import ExportedPolicy
from coil_rl.export.step import NotExportableError, PolicyStep, exportable
from coil_rl.extras import require
from coil_rl.files import whole_file
from coil_rl.foreign.controllers import PerRow
from coil_rl.foreign.shared import SharedGuide
from coil_rl.guides.simple import EntryGuide
from coil_rl.output import progress, say
from coil_rl.ranges import Interval, checked
from coil_rl.run.controller import Controller
from coil_rl.run.folder import HANDED_OVER
from coil_rl.run.run import Run
from coil_rl.transforms.guide_transform import SeededGenerator


@checked
def export_policy(
    run: Run,
    folder: str | Path,
    *,
    which: str = HANDED_OVER,
    observations: Annotated[int, Interval(ge=1, le=1_000_000)] = 1_000,
    seed: int = 0,
    meanings: Mapping[str, Any] | None = None,
) -> ExportedPolicy:
    """Write the policy of a run as files of ONNX and torch.export with a contract, and return it.

    The files are `policy.onnx`, `policy.pt2`, `contract.json`, which says what the numbers mean,
    and `drive.py`, which drives without this package. Older ones are replaced. Nothing is written
    unless the file acts as `run.controller()` does.

    Args:
        run: finished.
        folder: for the files.
        which: policy, "handed_over" or "last".
        observations: number of steps in the env in which both are compared.
        seed: of these steps.
        meanings: of entries and of `action`, for the contract: texts, or mappings with some of
            `unit`, `meaning`, `bounds`, `padding`, `frame`. They go before what the env says.

    Raises:
        UserError: without the extra `export`, for a policy that cannot be exported, and for one
            that acts differently.
    """
    require("an exported policy", "export", "onnx", "onnxscript", "onnxruntime")
    controller = run.controller(which)
    try:
        exportable(controller)
        say(f"export: {observations:,} observations of {run.label} in its env ...")
        with progress(
            total=observations, unit="step", desc="export", leave=False, mininterval=0.5
        ) as bar:
            recorded = record(run, controller, observations, seed, bar.update)
        step, contents, parity, outside = _possible(run, controller, recorded)
    except NotExportableError as error:
        raise UserError(
            f"run {run.folder}: its policy cannot be exported: {error}; use run.controller()"
        ) from error
    contract = describe(
        run,
        controller,
        step,
        parity,
        which=which,
        outside=outside,
        meanings=meanings or {},
    )
    contents[ONNX] = explained(contents[ONNX], contract)
    files = {
        name: {"sha256": checksum(content), "bytes": len(content)}
        for name, content in contents.items()
    }
    _save(Path(folder), contents, contract | {"files": files})
    say(f"export: {parity}")
    acts = contract["policy"]["acts"]
    if run.make_learner is not None and acts != LEARNED:
        passed = ""
        if outside is not None and acts.startswith("guide "):
            passed = ", and its file only passes guide_action on"
        say(
            f"export: what the run handed over is {acts}{passed}; policy=last exports the last "
            'learned policy, which="last" in Python'
        )
    return ExportedPolicy(folder)


def _possible(
    run: Run, controller: Controller, recorded: list[Step]
) -> tuple[PolicyStep, dict[str, bytes], Parity, str | None]:
    """Export a policy with its guides in the file if that is possible, and else without them.

    Returns:
        What `_written` returns, and why the guides are not in the file; None if they are.

    Raises:
        NotExportableError: if the policy cannot be exported.
    """
    outside = _cause(controller)
    if outside is None:
        try:
            return *_written(controller, recorded, inside=True), None
        except NotExportableError as error:
            outside = str(error)
    if controller.guides is None or run.make_learner is None:  # nothing is left without the guide
        raise NotExportableError(outside)
    step, contents, parity = _written(controller, recorded, inside=False)
    if step.guides:
        say(f"export: the guide stays outside, its action is an input: {outside}")
    return step, contents, parity, outside


def _written(
    controller: Controller, recorded: list[Step], *, inside: bool
) -> tuple[PolicyStep, dict[str, bytes], Parity]:
    """Return what is exported, the contents of the files, and how much they differ.

    Raises:
        NotExportableError: if that is not possible, or they differ too much.
    """
    step = PolicyStep(controller, inside=inside)
    limit = WITH_GUIDE if inside and step.guides else LIMIT
    say("export: writing the function ...")
    program = traced(step)
    contents = {TORCH: as_torch(program), ONNX: as_onnx(program, step)}
    say("export: comparing it with torch ...")
    parity = compare(step, contents[ONNX], recorded, limit)
    return step, contents, parity


def _cause(controller: Controller) -> str | None:
    """Return why the guides of a controller can only be outside; None if they may be inside."""
    guides = controller.guides
    if guides is None:
        return None
    for name, guide in guides.guides.guides.items():
        for part in guide.modules():
            if isinstance(part, PerRow):
                return f"guide {name} is a Python object for each row ({part.title})"
            if isinstance(part, SharedGuide) and not part.for_batch:
                return f"guide {name} is a Python function of one observation ({part.title})"
            if isinstance(part, SeededGenerator):
                return f"guide {name} draws numbers at random"
            if isinstance(part, EntryGuide) and part.in_keys[0][0] == "controller":
                return f"guide {name} is a controller beside its env"
    return None


def _save(folder: Path, contents: Mapping[str, bytes], contract: Mapping[str, Any]) -> None:
    """Write all files, the contract as the last one; none if one cannot be written."""
    driver = (resources.files("coil_rl.export") / DRIVER).read_bytes()
    text = json.dumps(contract, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with ExitStack() as stack:  # the first one to be entered is the last one to appear
        for name, content in {CONTRACT: text.encode(), **contents, DRIVER: driver}.items():
            stack.enter_context(whole_file(folder / name)).write_bytes(content)
