"""Survey of an agent in an env without sections: everywhere, and along the steps of an episode."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.lines import Line2D
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from coil_rl.listening.measures import drawn
from coil_rl.report import style, write_csv

if TYPE_CHECKING:
    from coil_rl.listening.survey import Survey

POINTS = 100  # of a curve, at most


class WholeEpisode:
    """No sections; the pictures show each measure along the steps of the episodes."""

    names: tuple[str, ...] = ()
    record: ClassVar[Mapping[str, NestedKey]] = {}

    def locate(self, state: TensorDictBase) -> dict[str, Tensor]:
        """Return nothing: the step is known."""
        return {}

    def section(self, place: TensorDictBase) -> Tensor:
        """Return 0 for each place."""
        return torch.zeros(place.batch_size, dtype=torch.int64, device=place.device)

    def draw(self, data: Survey, folder: Path) -> None:
        """Draw the mean of each measure against the step, and write the numbers as `listening.csv`."""
        size = max(1, -(-int(data.step.max() + 1) // POINTS))
        bins = data.step // size
        states = np.bincount(bins)
        rows: list[dict[str, Any]] = []
        for slot, guide in enumerate(data.guides):
            means = {name: np.bincount(bins, values[:, slot]) / states for name, values in data.measures.items()}
            rows += [
                {"guide": guide, "from": k * size, "states": int(states[k])}
                | {name: float(values[k]) for name, values in means.items()}
                for k in range(len(states))
            ]
        strokes = style.strong_strokes(data.guides)
        handles: list[Artist] = [
            Line2D([], [], color=stroke.colour, ls=stroke.linestyle, label=guide) for guide, stroke in strokes.items()
        ]
        for measure, title, label, name in drawn(data.measures):
            with style.picture(folder / name, title, handles, 3.6) as figure:
                axes = figure.add_subplot(xlabel="step of the episode", ylabel=label)
                style.lighten(axes)
                for guide, stroke in strokes.items():
                    own = [row for row in rows if row["guide"] == guide]
                    x, y = [row["from"] for row in own], [row[measure] for row in own]
                    axes.plot(x, y, color=stroke.colour, ls=stroke.linestyle, lw=1.5)
        write_csv(rows, folder / "listening.csv")
