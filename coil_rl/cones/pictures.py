"""The picture of an evaluation in a world of tracks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from coil_rl.cones.lines import animate_lines, draw_lines
from coil_rl.report.pictures import Picture

if TYPE_CHECKING:
    from tensordict import NestedKey

    from coil_rl.envs.track import Track
    from coil_rl.run.evaluation import EvaluationResult


@dataclass(eq=False)
class DrivenLines(Picture):
    """Driven lines on the tracks as `lines.png`, and as an animation, `lines.gif`.

    Args:
        tracks: of the cases, in their order; further cases drive them again, and are not drawn.
        gif: whether to make the animation, for an env that has a `rate`.
        most: number of tracks that are drawn, the first ones.
    """

    record: ClassVar[Mapping[str, NestedKey]] = {"pose": ("info", "pose")}
    tracks: Sequence[Track]
    gif: bool = True
    most: int = 12

    def draw(self, results: Mapping[str, EvaluationResult], folder: Path) -> None:
        """Draw the lines; see `Picture.draw`.

        Args:
            results: the episodes of each policy, one for each case, in the same cases.
            folder: where the pictures are written.
        """
        cases = len(next(iter(results.values())).episodes)
        tracks = self.tracks[: min(self.most, cases)]
        lines, crashed = {}, {}
        for policy, result in results.items():
            first = result[: len(tracks)]
            lines[policy] = [pose[:, :2] for pose in first.histories["pose"]]
            crashed[policy] = [row.get("crashed", False) > 0 for row in first.episodes]
        draw_lines(tracks, lines, folder / "lines.png", crashed=crashed)
        rate = next(iter(results.values())).rate
        if self.gif and not math.isnan(rate):
            animate_lines(tracks, lines, folder / "lines.gif", rate=rate, crashed=crashed)
