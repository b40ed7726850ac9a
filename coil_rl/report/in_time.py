"""The first case of an evaluation in time: what is observed, advised and sent, step by step."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
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
MOST = {"observation": 6, "action": 3}  # numbers that are drawn
PANEL_HEIGHT = 0.85  # inches


@dataclass
class Trace:
    """The steps of one policy in the first case, in the units of the env.

    Attributes:
        observed: what it saw before each step.
        advice: what its first guide advised; empty without advice.
        sent: the action that was executed.
    """

    observed: list[list[float]] = field(default_factory=list)
    advice: list[list[float]] = field(default_factory=list)
    sent: list[list[float]] = field(default_factory=list)


class InTime(Picture):
    """The first case in time, as `in_time.png`: guide and policy over each other.

    A panel for each number of the observation and of the action, the first ones of many. Time is in
    seconds if the env says its rate, else in steps.
    """

    def __init__(self) -> None:
        self.traces: dict[str, Trace] = {}

    @property
    def watches(self) -> bool:
        """Whether it needs to see the env: it does."""
        return True

    def watch(
        self,
        env: EnvBase,
        rows: Mapping[str, int],
        before: TensorDictBase,
        after: TensorDictBase,
    ) -> None:
        """Note a step of each policy; see `Picture.watch`."""
        key = env.action_key
        space = ActionSpace(env.full_action_spec[key], env.batch_dims)
        units = given_units(env)

        def numbers(action: Tensor) -> list[list[float]]:
            given = action if units is None else units.denormalise(action)
            return _numbers(given, len(env.batch_size), MOST["action"])

        sent = numbers(after[EXECUTED] if EXECUTED in after else before[key])
        advice = numbers(space.actions(before[ADVICE][..., 0, :])) if ADVICE in before else []
        seen = before.get(OBSERVED, None)
        observed = [] if seen is None else _numbers(seen, len(env.batch_size), MOST["observation"])
        for name, row in rows.items():
            trace = self.traces.setdefault(name, Trace())
            trace.sent.append(sent[row])
            trace.advice += [advice[row]] if advice else []
            trace.observed += [observed[row]] if observed else []

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


def _numbers(values: Tensor, batch_dims: int, most: int) -> list[list[float]]:
    """Return the first numbers of each row."""
    flat = values.reshape(values.shape[:batch_dims].numel(), -1)[:, :most]
    found: list[list[float]] = flat.double().tolist()
    return found


def draw_in_time(traces: Mapping[str, Trace], path: style.Target, *, rate: float) -> None:
    """Draw the steps of several policies over each other.

    Args:
        traces: by name, at least one.
        path: output file, or a buffer for an SVG.
        rate: steps per second; NaN if it is not known.
    """
    strokes = style.strokes(traces)
    panels = _panels(traces)
    handles = [
        Line2D([], [], color=strokes[name].colour, ls=strokes[name].linestyle, label=name)
        for name in traces
    ]
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
        tables = {"observation": trace.observed, "action": trace.sent, "": trace.advice}
        for kind, steps in tables.items():
            title, dotted = kind or "action", not kind
            if dotted and trace.advice == trace.sent:  # a guide that acts alone
                continue
            columns = np.array(steps, dtype=np.float64).T if steps else np.empty((0, 0))
            for number, column in enumerate(columns):
                titled = title if len(columns) == 1 else f"{title} {number}"
                panels.setdefault(titled, []).append((name, column, dotted))
    return dict(sorted(panels.items(), key=lambda panel: panel[0].startswith("action")))
