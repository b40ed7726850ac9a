"""What moves in an animation, drawn with Pillow, for Matplotlib would draw the tracks anew in every frame."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
from matplotlib import font_manager
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from coil_rl.report import style

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

FINER = 4  # cars are drawn this much larger and shrunk, for Pillow draws no smooth edges


class Car:
    """A car as an arrowhead with a fading tail.

    Args:
        line: where it is at each step, [T, 2] px, T at least 1.
        colour: of car and tail.
        length: of the car in px.
        crashes: whether it ends as a cross.
    """

    def __init__(self, line: Array, colour: Colour, length: float, crashes: bool) -> None:
        self.line, self.colour, self.length, self.crashes = line, colour, length, crashes
        step = np.diff(line, axis=0, append=line[-1:])
        moves = np.linalg.norm(step, axis=1) > 1e-6
        # Standing still keeps the heading; a car that never moves points to the right.
        last = np.maximum.accumulate(np.where(moves, np.arange(len(line)), -1))
        self.heading = np.where(last >= 0, np.arctan2(step[last, 1], step[last, 0]), 0.0)

    def draw(self, frame: Image.Image, step: float, tail: float) -> None:
        """Draw the car as it is after a number of steps, with a tail of so many steps, on an RGB image."""
        end = len(self.line) - 1
        now = min(step, end)
        path = self._at(np.linspace(max(0.0, min(step - tail, now)), now, 25))
        # No larger than the image, so that a driver who left it for good costs nothing.
        low = np.floor(np.maximum(path.min(axis=0), 0) - self.length).astype(int)
        size = np.ceil(np.minimum(path.max(axis=0), frame.size) + self.length).astype(int) - low
        if (size <= 0).any():
            return
        mask = Image.new("L", (int(size[0]) * FINER, int(size[1]) * FINER))
        rim = mask.copy()
        pen, rim_pen = ImageDraw.Draw(mask), ImageDraw.Draw(rim)
        path = (path - low) * FINER
        for level, (start, stop) in enumerate(itertools.pairwise(path)):
            # The newer piece overwrites the older one, so overlaps do not add up.
            pen.line([*start, *stop], fill=200 * (level + 1) // len(path), width=round(0.3 * self.length * FINER))
        crash = self.crashes and step >= end
        for points in self._cross(path[-1]) if crash else self._arrow(path[-1], self.heading[round(now)]):
            rim_pen.line([*points, points[0], points[1]], fill=255, width=2 * FINER, joint="curve")
            rim_pen.polygon(points, fill=255)
            pen.polygon(points, fill=255)
        corner = int(low[0]), int(low[1])
        frame.paste(rgb(style.PAPER), corner, rim.reduce(FINER))
        frame.paste(self.colour, corner, mask.reduce(FINER))

    def _at(self, steps: Array) -> Array:
        index = np.arange(len(self.line))
        return np.stack([np.interp(steps, index, self.line[:, axis]) for axis in (0, 1)], axis=1)

    def _arrow(self, centre: Array, heading: float) -> list[list[tuple[float, float]]]:
        ahead = np.array([np.cos(heading), np.sin(heading)]) * self.length * FINER
        aside = np.array([-ahead[1], ahead[0]])
        corners = ((0.5, 0), (-0.5, 0.36), (-0.3, 0), (-0.5, -0.36))
        return [[tuple(centre + a * ahead + b * aside) for a, b in corners]]

    def _cross(self, centre: Array) -> list[list[tuple[float, float]]]:
        reach = self.length * FINER * 0.45
        thick = reach * 0.3
        bars = []
        for sign in (1, -1):
            along, across = np.array([1, sign]) * reach, np.array([-sign, 1]) * thick
            bars.append([tuple(centre + p) for p in (along + across, across - along, -along - across, along - across)])
        return bars


def draw_clock(frame: Image.Image, text: str) -> None:
    """Write a text into the lower right corner of an RGB image."""
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), round(8 / 72 * style.SCREEN_RESOLUTION))
    place = frame.width - 18, frame.height - 14
    ImageDraw.Draw(frame).text(place, text, fill=rgb(style.INK), font=font, anchor="rm")


def shared_palette(background: Image.Image, colours: Iterable[Colour]) -> Image.Image:
    """256 colours for every frame alike: the background's, and shades from the ground to each driver's colour."""
    colours = list(dict.fromkeys(colours))
    grounds = [rgb(style.ASPHALT), rgb(style.PAPER)]
    plain = [*grounds, *(rgb(colour) for colour in (style.INK, style.LEFT_CONE, style.RIGHT_CONE))]
    levels = 96 // max(1, len(grounds) * len(colours))
    shades = [
        tuple(round(g + (c - g) * (level + 1) / levels) for g, c in zip(ground, colour, strict=True))
        for colour in colours
        for ground in grounds
        for level in range(levels)
    ]
    # One short of 256: the GIF writer needs a colour for "unchanged".
    still = np.array(background.quantize(255 - len(plain) - len(shades)).getpalette()).reshape(-1, 3)
    # Pillow matches colours by their upper six bits, so paper would become the almost white next to it.
    near = np.abs(still[:, None] - np.array(plain)).max(axis=-1) < 8
    still = np.where(near.any(axis=1, keepdims=True), np.array(plain)[near.argmax(axis=1)], still)
    image = Image.new("P", (1, 1))
    image.putpalette(np.vstack([plain, shades, still] if shades else [plain, still]).flatten().tolist())
    return image


def rgb(colour: str) -> Colour:
    """The three bytes of a colour that Matplotlib knows."""
    red, green, blue = (round(255 * part) for part in to_rgb(colour))
    return red, green, blue
