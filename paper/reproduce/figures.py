"""Figures 10, 19, 21, 26, 30 and 31 of the paper, which show how its parts work.

Each is drawn from the parts themselves, such as the loss of the learner or the plan of the guide.
"""

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from coil_paper.reproduce.result import NO_RUNS, PAGES, Result, Runs
from coil_rl import PPO, ConeTrackEnv, SplineGuide, shipped_tracks
from coil_rl.envs import (
    SIDES,
    Frame,
    Perception,
    resample,
    shipped_track,
    simulated_cone_classifier,
    simulated_drive,
)
from coil_rl.envs.robot import RANGE_MAX, points_of
from coil_rl.ranges import Interval, checked
from coil_rl.report import style, write_csv

Array = NDArray[np.float64]

RATIOS = np.linspace(0.005, 1.995, 200)
SEED, SCAN = 100, 61  # of a drive that is not in the classifier's training set
DISTANCES = (1.0, 1.5, 2.0, 3.0, 5.0)  # m
SPLINE_POINTS = 60

# By title: by name of a series, points [N, 2], NaN between two lines. And the numbers in the notes.
Panels = tuple[Mapping[str, Mapping[str, Array]], Mapping[str, Any]]


class Drawing(Result):
    """A figure of named series of points, in one panel or several.

    Its number is in the name of the class; `paper/conf/result_pages.yaml` has its words, axes and
    lines.
    """

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        number = type(self).__name__.removeprefix("Figure")
        page = PAGES[f"figure_{number}"]
        panels, numbers = self._panels()
        title = f"Figure {number}: {page['title']}"
        names = list(dict.fromkeys(chain.from_iterable(panels.values())))
        lines = _lines(names, page.get("lines", {}))
        handles = [Line2D([], [], label=name, **lines[name]) for name in names]
        rows = page.get("rows", 1)
        with style.picture(stem.with_suffix(".png"), title, handles, page["height"]) as figure:
            grid = figure.subplots(rows, len(panels) // rows, squeeze=False)
            for axes, (heading, series) in zip(grid.flat, panels.items(), strict=True):
                axes.set_title(heading, size=9, color=style.QUIET)
                axes.set(**page["axes"])
                style.lighten(axes)
                for name, points in series.items():
                    axes.plot(*points.T, **lines[name])
        write_csv(_rows(panels), stem.with_suffix(".csv"))
        return f"## {title}\n\n{page['notes'].format(**numbers)}"

    @abstractmethod
    def _panels(self) -> Panels:
        """Return the series of each panel, and the numbers in the notes."""


def _lines(
    names: Sequence[str], configured: Mapping[str, tuple[str, Mapping[str, Any]]]
) -> dict[str, dict[str, Any]]:
    """Return the options of matplotlib for the line of each series.

    Args:
        configured: by name of a series a colour and options; the others get a strong colour.
    """
    lines: dict[str, dict[str, Any]] = {}
    for name, stroke in style.strong_strokes(names).items():
        lines[name] = {"color": stroke.colour}
    for name, (colour, options) in configured.items():
        own_colour = getattr(style, colour, colour)
        lines[name] = {"color": own_colour, "mec": style.INK, "mew": 0.4, **options}
    return lines


def _rows(panels: Mapping[str, Mapping[str, Array]]) -> list[dict[str, Any]]:
    """Return the points of all series as rows of a table."""
    rows = []
    for heading, series in panels.items():
        for name, points in series.items():
            finite = points[np.isfinite(points).all(1)]
            for x, y in finite.tolist():
                rows.append({"panel": heading, "series": name, "x": x, "y": y})
    return rows


class Figure10(Drawing):
    """One term of PPO's objective against the probability ratio.

    There is a panel for either sign of the advantage.
    """

    def _panels(self) -> Panels:
        env = ConeTrackEnv([shipped_track("train_1")], num_envs=2)
        ppo = PPO(env)
        rows = ppo.policy(env.reset()).detach().set("value_target", torch.zeros(2, 1))
        log_prob = rows["action_log_prob"]
        panels, clipped = {}, []
        for sign, title in ((-1.0, "A < 0"), (1.0, "A > 0")):
            points = []
            for ratio in RATIOS.tolist():
                # The loss is the mean of two terms; the second one has the ratio 1 and the opposite
                # advantage.
                old = (log_prob - torch.tensor([math.log(ratio), 0.0])).requires_grad_()
                rows["action_log_prob"], rows["advantage"] = old, torch.tensor([[sign], [-sign]])
                points.append(_term(ppo, rows, sign))
            term, slopes = np.split(np.array(points), [2], axis=1)
            clipped.append(term[slopes[:, 0] == 0])
            one = np.array([[1.0, sign]])
            panels[title] = {"one term": term, "clipped": clipped[-1], "r = 1": one}
        return panels, {"low": clipped[0][:, 0].max(), "high": clipped[1][:, 0].min()}


def _term(ppo: PPO, rows: TensorDictBase, advantage: float) -> tuple[float, float, float]:
    """Return the ratio, the value and the slope of the first of two terms of PPO's objective.

    Args:
        rows: two rows of a batch; the second one has the ratio 1 and the opposite advantage.
        advantage: of the first row, 1 or -1.
    """
    losses = ppo.losses(rows)
    slope = torch.autograd.grad(losses["loss_objective"], rows["action_log_prob"])[0]
    # Standardised, the advantages are 1 / sqrt(2) and its opposite.
    gain = advantage - 2 * math.sqrt(2) * float(losses["loss_objective"].detach())
    return float(losses["log_ratio"][0].detach().exp()), gain, float(slope[0])


@checked
class OnTheWay(Drawing):
    """A moment of the guide's drive on a shipped track. The car faces up, positions are in m.

    Args:
        track: name of the track.
        seconds: the time since the start of the drive, from 0 to 60.
    """

    def __init__(
        self, track: str = "train_1", seconds: Annotated[float, Interval(ge=0, le=60)] = 10.0
    ) -> None:
        self.track, self.seconds = shipped_track(track), seconds
        self.about: dict[str, Any] = {"track": track, "seconds": seconds}

    @torch.no_grad()
    def drive(self) -> tuple[ConeTrackEnv, TensorDictBase]:
        """Return the env at the moment, and its state with the advice of the guide, [1]."""
        env, guide = ConeTrackEnv([self.track], num_envs=1), SplineGuide()
        state = env.reset()
        for _ in range(round(self.seconds * env.rate)):
            state = step_mdp(env.step(guide(state)))
        return env, guide(state)


class Figure19(OnTheWay):
    """The simulator: a car on a track, its detected cones, and its estimates of both boundaries."""

    def _panels(self) -> Panels:
        env, state = self.drive()
        frame, count = Frame(env.pose.double()), state["cone_count"]
        around = {"left cones": self.track.left, "right cones": self.track.right}
        around["middle"] = resample(self.track.middle(), 1.0)
        series = {}
        for name, points in around.items():
            series[name] = facing_up(frame.to_car(torch.tensor(points.T)))
        seen = np.concatenate(list(visible(state["cones"][0], count[0]).values()))
        # A line from the car to each detected cone; NaN ends a line.
        series["detected"] = np.stack([0 * seen, seen, seen + np.nan], 1).reshape(-1, 2)
        boundaries = frame.to_car(env.samples.double())[..., 0].unbind(2)
        for side, samples in zip(SIDES, boundaries, strict=True):
            series[f"estimate of the {side} boundary"] = facing_up(samples)
        numbers = {"left": int(count[0, 0]), "right": int(count[0, 1])}
        return {"": {**series, "car": np.zeros((1, 2))}}, self.about | numbers


class Figure21(Drawing):
    """The cones of the first four training tracks."""

    def _panels(self) -> Panels:
        tracks = shipped_tracks("train")[:4]
        panels = {
            track.name: {"left cones": track.left, "right cones": track.right} for track in tracks
        }
        lengths = ", ".join(f"{track.name} {track.length:.1f} m" for track in tracks)
        return panels, {"lengths": lengths}


class Figure26(Drawing):
    """A scan of the simulated robot's LiDAR, and the cones that the robot detects in it.

    The robot faces up, positions are in m.
    """

    def _panels(self) -> Panels:
        drive, perception = simulated_drive("both", SEED), Perception(simulated_cone_classifier())
        ranges, angles = drive.ranges[[SCAN]].numpy(), drive.angles.numpy()
        points = points_of(ranges, angles, perception.range_min, RANGE_MAX)
        cones, count = map(torch.from_numpy, perception(ranges, angles))
        series = {**visible(cones[0] / perception.scale, count[0]), "robot": np.zeros((1, 2))}
        series["LiDAR points"] = facing_up(torch.from_numpy(np.stack([points.x, points.y])))
        numbers: dict[str, Any] = {
            "scan": SCAN,
            "sight": perception.range_max,
            "side": perception.bearing_max,
        }
        for name, of_name in series.items():
            numbers[name.split()[0]] = len(of_name)
        return {"": series}, numbers


class Figure30(Drawing):
    """The steering angle that the guide advises against the bearing of its target (equation 103).

    There is a line for each of some distances of the target.
    """

    def _panels(self) -> Panels:
        guide, alpha = SplineGuide(), torch.linspace(-60, 60, 121, dtype=torch.float64)
        ahead = torch.stack([alpha.deg2rad().cos(), alpha.deg2rad().sin()])
        angles = {d: guide.max_steering * guide.pursuit(d * ahead) for d in DISTANCES}
        series = {}
        for d, beta in angles.items():
            series[f"d = {d:g} m"] = torch.stack([alpha, beta], 1).numpy()
        greatest = ", ".join(f"{beta[-1]:.1f}° at {d:g} m" for d, beta in angles.items())
        return {"": series}, {"greatest": greatest}


class Figure31(OnTheWay):
    """The guide's path in three steps.

    They are the midpoints of pairs of cones, a spline through them, and the targets on it.
    """

    def _panels(self) -> Panels:
        _, state = self.drive()
        cones, count = state["cones"], state["cone_count"]
        plan = SplineGuide().plan(cones, count)
        pairs = int(plan.midpoint_count)
        seen = {**visible(cones[0], count[0]), "car": np.zeros((1, 2))}
        midpoints = {"midpoints of pairs": facing_up(plan.midpoints[:, :pairs, 0])}
        spline = {"smoothing spline": facing_up(plan.path.equidistant(SPLINE_POINTS)[..., 0])}
        # A shorter path repeats its last target.
        targets = {"targets": np.unique(facing_up(plan.targets[..., 0]), axis=0)}
        panels = {"midpoints": seen | midpoints, "spline": seen | midpoints | spline}
        numbers = {"pairs": pairs, "targets": len(targets["targets"])}
        return panels | {"targets": seen | spline | targets}, self.about | numbers


def facing_up(points: Tensor) -> Array:
    """Rotate points from the car's frame (x ahead, y left) to that of the picture (y ahead).

    Args:
        points: [2, N] m.

    Returns:
        [N, 2] m.
    """
    return torch.stack([-points[1], points[0]], 1).double().numpy()


def visible(cones: Tensor, count: Tensor) -> dict[str, Array]:
    """Return the visible cones of either side in the frame of the picture.

    Args:
        cones: [2, K, 2] m, in the car's frame, padded.
        count: [2], number of real cones of each side.

    Returns:
        By side, [N, 2] m.
    """
    visible = {}
    for side, of_side, number in zip(SIDES, cones, count.tolist(), strict=True):
        visible[f"{side} cones"] = facing_up(of_side[:number].t())
    return visible
