"""The first case of an evaluation in time: what is observed, advised and sent, step by step."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.lines import Line2D
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from coil_rl.foreign.gymnasium_env import NOT_OBSERVED
from coil_rl.report import style
from coil_rl.report.pictures import Picture
from coil_rl.report.statistics import Array
from coil_rl.transforms.action_space import ActionSpace, own_forms, space_of
from coil_rl.transforms.discrete_actions import DiscreteActions
from coil_rl.transforms.normalised_action import given_units

if TYPE_CHECKING:
    from coil_rl.run.evaluation import EvaluationResult

EXECUTED = "executed_action"
MOST_OBSERVED, MOST_OF_ACTION = 6, 3  # numbers that are drawn
PANEL_HEIGHT = 0.85  # inches


# Of one policy in the first case, in the units of the env: what it observed before each step, by
# entry, the action that was executed, and what its first guide advised; without what it does not
# have.
Trace = dict[str, list[list[float]]]
ACTION, ADVISED = "action", "guide_action"


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
        shown = _observed(env, before) | _actions(env, before, after)
        for title, values in shown.items():
            flat = values.reshape(env.batch_size.numel(), -1).double().tolist()
            for name, row in rows.items():
                self.traces.setdefault(name, {}).setdefault(title, []).append(flat[row])

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


def _observed(env: EnvBase, before: TensorDictBase) -> dict[str, Tensor]:
    """Return the first numbers that an env shows, [*batch, n], by the title of their entry.

    They are those of `observation`; without it, those of all entries but pictures. Choices are in
    the numbering of the env.
    """
    base, left = _base(env), MOST_OBSERVED
    own, shown = own_forms(base), dict[str, Tensor]()
    keys = list(base.observation_spec.keys(True, True))
    for key in ["observation"] if "observation" in keys else keys:
        value = None if key[0] in NOT_OBSERVED else before.get(key, None)
        if value is None or value.dtype == torch.uint8 or not left:
            continue
        numbers = own[key](value) if key in own else value
        numbers = numbers.reshape(*env.batch_size, -1)[..., :left]
        shown[key if isinstance(key, str) else ".".join(key)] = numbers
        left -= numbers.shape[-1]
    return shown


def _actions(env: EnvBase, before: TensorDictBase, after: TensorDictBase) -> dict[str, Tensor]:
    """Return the executed action and the advice of the first guide, as the env takes actions."""
    key, units, own = env.action_key, given_units(env), space_of(_base(env), env.action_key)
    values = [part.values for part in env.modules() if isinstance(part, DiscreteActions)]
    space = ActionSpace(env.full_action_spec[key], env.batch_dims)

    def numbers(action: Tensor) -> Tensor:
        """Return the value of an agent's choice of a number, else its action."""
        return values[0][action].unsqueeze(-1) if values else action

    given = {ACTION: after[EXECUTED] if EXECUTED in after else numbers(before[key])}
    if ADVISED in before:
        given[ADVISED] = numbers(space.actions(before[ADVISED][..., 0, :]))
    shown = {}
    for title, action in given.items():
        sent = own.executed(action if units is None else units.denormalise(action))
        shown[title] = sent.reshape(*env.batch_size, -1)[..., :MOST_OF_ACTION]
    return shown


def _base(env: EnvBase) -> EnvBase:
    return env.base_env if isinstance(env, TransformedEnv) else env


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
