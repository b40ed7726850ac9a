"""Pictures of an evaluation.

A run draws those that the configuration of its env names (`evaluation.pictures`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from coil_rl.report import style

if TYPE_CHECKING:
    from tensordict import NestedKey, TensorDictBase
    from torchrl.envs import EnvBase

    from coil_rl.run.evaluation import EvaluationResult


class Picture:
    """A picture of deterministic episodes.

    Attributes:
        record: entries of every step that the picture needs, by name.
        watches: whether the picture needs to see the env, by `watch`.
    """

    record: ClassVar[Mapping[str, NestedKey]] = {}
    watches = False

    def watch(
        self,
        env: EnvBase,
        rows: Mapping[str, int],
        before: TensorDictBase,
        after: TensorDictBase,
    ) -> None:
        """See the env after each step; by default do nothing.

        Args:
            rows: the row in which each policy drives the first case, of those that still drive.
            before: the entries before the step, with the action.
            after: the entries after it.
        """

    def draw(self, results: Mapping[str, EvaluationResult], folder: Path) -> None:
        """Draw the picture.

        Args:
            results: the episodes of each policy, one for each case.
            folder: where the picture is written.
        """
        raise NotImplementedError


class Returns(Picture):
    """Return of each policy in each case, as `returns.png`."""

    def draw(self, results: Mapping[str, EvaluationResult], folder: Path) -> None:
        """Draw one row for each policy, with a dot for each episode and a line at the mean.

        Args:
            results: the episodes of each policy.
            folder: where the picture is written.
        """
        names, strokes = list(results)[::-1], style.strokes(results)
        with style.picture(folder / "returns.png", None, [], 0.9 + 0.45 * len(names)) as figure:
            axes = figure.add_subplot(xlabel="return of an episode")
            style.lighten(axes)
            for row, name in enumerate(names):
                rewards = np.array([episode["reward"] for episode in results[name].episodes])
                # Spread evenly, so that equal returns stay visible.
                heights = row + 0.3 * (np.arange(len(rewards)) / max(1, len(rewards) - 1) - 0.5)
                colour = strokes[name].colour
                axes.plot(rewards, heights, "o", color=colour, ms=4, alpha=0.5, mew=0)
                axes.plot([rewards.mean()] * 2, [row - 0.3, row + 0.3], color=colour, lw=2)
            axes.set_yticks(range(len(names)), names)
