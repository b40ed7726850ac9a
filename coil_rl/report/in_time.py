"""The first case of an evaluation in time: what is observed, advised and sent, step by step."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.lines import Line2D
from tensordict import TensorDictBase
from torch import Tensor

from coil_rl.report import style
from coil_rl.report.pictures import Picture
from coil_rl.report.statistics import Array
from coil_rl.transforms.action_space import ActionSpace
from coil_rl.transforms.normalised_action import given_units

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from coil_rl.run.evaluation import EvaluationResult

OBSERVED, ADVICE, EXECUTED = "observation", "guide_action", "executed_action"
MOST = {"observation": 6, "action": 3, "advice": 3}  # numbers that are drawn
PANEL_HEIGHT = 0.85  # inches


# Of one policy in the first case, in the units of the env: what it observed before each step, the
# action that was executed, and what its first guide advised; without what it does not have.
Trace = dict[str, list[list[float]]]
OBSERVATION, ACTION, ADVISED = "observation", "action", "advice"


class InTime(Picture):
    """The first case in time, as `in_time.png`: guide and policy over each other.

    A panel for each number of the observation and of the action, the first ones of many. Time is in
    seconds if the env says its rate, else in steps.
    """

    watches = True

    def __init__(self) -> None:
        self.traces: dict[str, Trace] = {}

    def watch(
        self,
        env: EnvBase,
        rows: Mapping[str, int],
        before: TensorDictBase,
        after: TensorDictBase,
    ) -> None:
        """Note a step of each policy; see `Picture.watch`."""
        key, units = env.action_key, given_units(env)
        shown: dict[str, Tensor] = {}
        if OBSERVED in before:
            shown[OBSERVATION] = before[OBSERVED]
        shown[ACTION] = after[EXECUTED] if EXECUTED in after else before[key]
        if ADVICE in before:
            space = ActionSpace(env.full_action_spec[key], env.batch_dims)
            shown[ADVISED] = space.actions(before[ADVICE][..., 0, :])
        for kind, values in shown.items():
            is_action = kind != OBSERVATION
            given = units.denormalise(values) if is_action and units is not None else values
            flat = given.reshape(env.batch_size.numel(), -1)[:, : MOST[kind]].double().tolist()
            for name, row in rows.items():
                self.traces.setdefault(name, {}).setdefault(kind, []).append(flat[row])

    def draw(self, results: Mapping[str, EvaluationResult], folder: Path) -> None:
        """Draw the picture.

        Args:
            results: the episodes of each policy, the agent last.
            folder: where it is written.
        """
        traces, self.traces = self.traces, {}
        shown = {name: traces[name] for name in results if name in traces}
        if shown:
            rate = next(iter(results.values())).rate
            draw_in_time(shown, folder / "in_time.png", rate=rate)


def draw_in_time(traces: Mapping[str, Trace], path: style.Target, *, rate: float) -> None:
    """Draw the steps of several policies over each other.

    Args:
        traces: by name, at least one.
        path: output file, or a buffer for an SVG.
        rate: steps per second; NaN if it is not known.
    """
    strokes = style.strokes(traces)
    panels = _panels(traces)
    handles = style.handles(strokes)
    if any(name for lines in panels.values() for name, _, dotted in lines if dotted):
        handles.append(Line2D([], [], color=style.QUIET, ls=":", label="advice to a policy"))
    height = 0.45 + PANEL_HEIGHT * len(panels)
    with style.picture(path, None, handles, height, add_header=True, h_pad=0.03) as figure:
        column = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (title, lines) in zip(column, panels.items(), strict=True):
            style.lighten(axes)
            axes.set_ylabel(title, size=8, rotation=0, ha="right", va="center")
            axes.tick_params(labelsize=8)
            axes.margins(x=0.01)
            for name, values, dotted in lines:
                time = np.arange(len(values)) / (1 if math.isnan(rate) else rate)
                colour, linestyle = strokes[name]
                axes.plot(time, values, color=colour, ls=":" if dotted else linestyle, lw=1.2)
        column[-1].set_xlabel("steps" if math.isnan(rate) else "seconds")


def _panels(traces: Mapping[str, Trace]) -> dict[str, list[tuple[str, Array, bool]]]:
    """Return the lines of each panel: name of the policy, numbers, and whether they are advice."""
    panels: dict[str, list[tuple[str, Array, bool]]] = {}
    for name, trace in traces.items():
        for kind, steps in trace.items():
            is_advice = kind == ADVISED
            if is_advice and steps == trace[ACTION]:  # a guide that acts alone
                continue
            columns = np.array(steps, dtype=np.float64).T
            for number, column in enumerate(columns):
                title = ACTION if is_advice else kind
                titled = title if len(columns) == 1 else f"{title} {number}"
                panels.setdefault(titled, []).append((name, column, is_advice))
    return dict(sorted(panels.items(), key=lambda panel: panel[0].startswith("action")))
