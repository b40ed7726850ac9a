"""Pictures of an evaluation, which a run draws from the configuration of its env."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from coil_rl.files import whole_file
from coil_rl.report import style
from coil_rl.report.lines import animate_lines, draw_lines

if TYPE_CHECKING:
    from tensordict import NestedKey
    from torchrl.envs import EnvBase

    from coil_rl.envs.track import Track
    from coil_rl.run.evaluation import EvaluationResult


class Picture:
    """A picture of deterministic episodes."""

    record: ClassVar[Mapping[str, NestedKey]] = {}  # entries of every step that it needs, by name

    def watch(self, env: EnvBase) -> None:
        """See the env before each step of the agent's deterministic episodes; by default do nothing."""

    def draw(self, drives: Mapping[str, EvaluationResult], folder: Path) -> None:
        """Draw the episodes of each driver, one for each case, into a folder."""
        raise NotImplementedError


@dataclass(eq=False)
class DrivenLines(Picture):
    """Driven lines on the tracks as `lines.png`, and as an animation, `lines.gif`."""

    record: ClassVar[Mapping[str, NestedKey]] = {"pose": ("info", "pose")}
    tracks: Sequence[Track]  # one for each case
    gif: bool = True  # whether to make the animation, for an env that has a `rate`
    most: int = 12  # tracks that are drawn, the first ones

    def draw(self, drives: Mapping[str, EvaluationResult], folder: Path) -> None:
        """Draw the lines."""
        tracks, first = (
            self.tracks[: self.most],
            {driver: result[: self.most] for driver, result in drives.items()},
        )
        lines = {
            driver: [pose[:, :2] for pose in result.histories["pose"]]
            for driver, result in first.items()
        }
        crashed = {
            driver: [bool(row.get("crashed")) for row in result.episodes]
            for driver, result in first.items()
        }
        draw_lines(tracks, lines, folder / "lines.png", crashed=crashed)
        rate = next(iter(drives.values())).rate
        if self.gif and not math.isnan(rate):
            animate_lines(tracks, lines, folder / "lines.gif", rate=rate, crashed=crashed)


class Returns(Picture):
    """Return of each driver in each case, as `returns.png`."""

    def draw(self, drives: Mapping[str, EvaluationResult], folder: Path) -> None:
        """Draw one row for each driver, with a dot for each episode and a line at the mean."""
        names, strokes = list(drives)[::-1], style.strokes(drives)
        with style.picture(folder / "returns.png", None, [], 0.9 + 0.45 * len(names)) as figure:
            axes = figure.add_subplot(xlabel="return of an episode")
            style.lighten(axes)
            for row, name in enumerate(names):
                rewards = np.array([episode["reward"] for episode in drives[name].episodes])
                # Spread evenly, so that equal returns stay visible.
                heights = row + 0.3 * (np.arange(len(rewards)) / max(1, len(rewards) - 1) - 0.5)
                axes.plot(rewards, heights, "o", color=strokes[name].colour, ms=4, alpha=0.5, mew=0)
                axes.plot(
                    [rewards.mean()] * 2, [row - 0.3, row + 0.3], color=strokes[name].colour, lw=2
                )
            axes.set_yticks(range(len(names)), names)


@dataclass(eq=False)
class Film(Picture):
    """The agent's episode in the first case as an animation, `episode.gif`, drawn by the env itself."""

    every: int = 2  # steps between two frames
    frames: int = 300  # at most
    width: int = 320  # of the animation in pixels, at most
    duration: int = 40  # of a frame in ms

    def __post_init__(self) -> None:
        self.images: list[Image.Image] = []
        self.steps = 0

    def watch(self, env: EnvBase) -> None:
        """Take a frame if it is time, and the first episode still runs."""
        if self.steps % self.every == 0 and len(self.images) < self.frames:
            pixels: NDArray[np.uint8] | None = env.render()
            if pixels is not None:
                image = Image.fromarray(pixels)
                image.thumbnail((self.width, self.width))
                self.images.append(image)
        self.steps += 1

    def draw(self, drives: Mapping[str, EvaluationResult], folder: Path) -> None:
        """Write the animation; nothing without frames."""
        steps = list(drives.values())[-1].episodes[0]["steps"]
        images = self.images[: max(1, -(-steps // self.every))]
        if images:
            with whole_file(folder / "episode.gif") as unfinished:
                images[0].save(
                    unfinished,
                    "GIF",
                    save_all=True,
                    append_images=images[1:],
                    duration=self.duration,
                    loop=0,
                )
