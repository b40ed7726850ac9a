"""Film of the first case of an evaluation: the guides left, the agent right; the env draws it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
from PIL import Image, ImageDraw, ImageFont

from coil_rl.files import whole_file
from coil_rl.output import say
from coil_rl.report import style
from coil_rl.report.pictures import Picture
from coil_rl.report.table import return_format

if TYPE_CHECKING:
    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

    from coil_rl.run.evaluation import EvaluationResult

LETTERS = 13  # pixels, the height of the letters of a caption
CAPTION = 22  # pixels, the height of a caption
GAP = 8  # pixels between two policies
ENDED = 0.45  # of a frame after the end of its episode: how much of it is still seen


@dataclass(eq=False)
class Film(Picture):
    """The first case as an animation, `episode.webp`: each guide and the agent side by side.

    Above each is its name with its return. An episode that has ended keeps its last frame, faint.
    Policies that drive the first case with altered advice are left out.

    Args:
        every: number of steps between two frames; None for those of the env in the duration of a
            frame, so that the film has the env's own pace. 2 for an env that does not say its rate.
        frames: largest number of frames.
        width: largest width and height of the frame of one policy, pixels; a larger picture is
            reduced by a whole number.
        duration: of a frame, ms.
        active: whether to make the film.
    """

    every: int | None = None
    frames: int = 200
    width: int = 320
    duration: int = 80
    active: bool = True

    def __post_init__(self) -> None:
        self.images: dict[str, list[Image.Image]] = {}  # of each policy
        self.steps: dict[str, int] = {}  # of the env so far
        self.whole = True  # whether no frame is missing
        self.watches = self.active

    def watch(
        self,
        env: EnvBase,
        rows: Mapping[str, int],
        before: TensorDictBase,
        after: TensorDictBase,
    ) -> None:
        """Take a frame of each policy if it is time; see `Picture.watch`.

        The env's `render(row)` returns a picture [height, width, 3], or None if it has none.
        """
        every = self._steps_of_frame(getattr(env, "rate", math.nan))
        for name, row in rows.items():
            images, steps = self.images.setdefault(name, []), self.steps.get(name, 0)
            self.steps[name] = steps + 1
            if not self.active or steps % every or len(images) >= self.frames:
                continue
            pixels = getattr(env, "render", lambda row: None)(row)
            if pixels is None:
                self.whole = False
            else:
                image = Image.fromarray(pixels).convert("RGB")
                # Means of whole blocks take a tenth of the time of any other size.
                images.append(image.reduce(-(-max(image.size) // self.width)))

    def _steps_of_frame(self, rate: float) -> int:
        """Return the number of steps between two frames, for an env of so many steps a second."""
        if self.every is not None:
            return self.every
        return 2 if math.isnan(rate) else max(1, round(rate * self.duration / 1000))

    def draw(self, results: Mapping[str, EvaluationResult], folder: Path) -> None:
        """Write the animation; print why not if an env gives no pictures, or stopped giving them.

        Args:
            results: the episodes of each policy, the agent last.
            folder: where the animation is written.
        """
        columns, captions = [], []
        taken, whole = self.images, self.whole
        self.__post_init__()  # for the next evaluation
        for name, result in results.items():
            first = result.episodes[0]
            # After its end an episode may be drawn as the next one.
            every = self._steps_of_frame(result.rate)
            images = taken.get(name, [])[: max(1, -(-first["steps"] // every))]
            if images:
                columns.append(images)
                spec = return_format([first["reward"]])
                captions.append(f"{name}: return {first['reward']:{spec}}")
        if not whole:
            say(
                f"{folder / 'episode.webp'} is not drawn: the env gives no pictures, as an env of "
                "Gymnasium does with rgb_array among the render_modes of its metadata",
                error=True,
            )
        if not (columns and whole):
            return
        frames = _side_by_side(columns, captions)
        with whole_file(folder / "episode.webp") as unfinished:
            frames[0].save(
                unfinished,
                "WEBP",
                save_all=True,
                append_images=frames[1:],
                duration=self.duration,
                loop=0,
                method=2,
            )


def _side_by_side(
    columns: Sequence[Sequence[Image.Image]], captions: Sequence[str]
) -> list[Image.Image]:
    """Return the frames of several films as one film.

    Args:
        columns: the frames of each film, at least one each, of one size.
        captions: above each.
    """
    *lefts, width = itertools.accumulate((each[0].width + GAP for each in columns), initial=0)
    height = CAPTION + max(images[0].height for images in columns)
    empty = Image.new("RGB", (width - GAP, height), style.BACKGROUND)
    for images, left, caption in zip(columns, lefts, captions, strict=True):
        _write(empty, left, caption, images[0].width)
    frames = []
    for number in range(max(map(len, columns))):
        frame = empty.copy()
        for images, left in zip(columns, lefts, strict=True):
            image = images[min(number, len(images) - 1)]
            if number >= len(images):
                blank = Image.new("RGB", image.size, style.BACKGROUND)
                image = Image.blend(blank, image, ENDED)
            frame.paste(image, (left, CAPTION))
        frames.append(frame)
    return frames


def _write(image: Image.Image, left: int, text: str, width: int) -> None:
    """Write a caption at the upper edge of an image, shortened to a width in pixels."""
    font = ImageFont.truetype(Path(mpl.get_data_path(), "fonts/ttf/DejaVuSans.ttf"), LETTERS)
    shown = text = " ".join(text.split())
    while font.getlength(shown) > width and text:
        text = text[:-1]
        shown = f"{text}…"
    ImageDraw.Draw(image).text((left, 2), shown, fill=style.INK, font=font)
