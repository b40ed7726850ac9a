"""Figures 10, 19, 21, 26, 30 and 31 of the paper, which show how its parts work, drawn from those parts."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.lines import Line2D
from torch import Tensor
from torchrl.envs.utils import step_mdp

from coil_rl.envs import ConeTrackEnv, Perception, shipped_track, shipped_tracks, simulated_drive
from coil_rl.envs.limits import check_range
from coil_rl.envs.robot.clusters import points_of
from coil_rl.envs.robot.lidar import RANGE_MAX
from coil_rl.envs.robot.perception import simulated_cone_classifier
from coil_rl.envs.sight import Frame
from coil_rl.envs.track import SIDES, Array, resample
from coil_rl.guides import SplineGuide
from coil_rl.learners.ppo import PPO
from coil_rl.report import style, write_csv
from coil_rl.reproduce.result import NO_RUNS, PAGES, Result, Runs

RATIOS = np.linspace(0.005, 1.995, 200)
SEED, SCAN = 100, 61  # of a drive that is not in the classifier's training set
DISTANCES = (1.0, 1.5, 2.0, 3.0, 5.0)  # m
SPLINE_POINTS = 60

# By title: by name of a series, points [N, 2], NaN between two lines. And the numbers in the notes.
Panels = tuple[Mapping[str, Mapping[str, Array]], Mapping[str, Any]]


class Drawing(Result):
    """A figure of named series of points, one panel or several; `conf/result_pages.yaml` has its words and lines.

    Its number is in the name of the class.
    """

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        number = type(self).__name__.removeprefix("Figure")
        page = PAGES[f"figure_{number}"]
        panels, numbers = self._panels()
        names = list(dict.fromkeys(chain.from_iterable(panels.values())))
        lines: dict[str, Any] = {
            name: {"color": stroke.colour} for name, stroke in style.strong_strokes(names).items()
        }
        for name, (colour, line) in page.get("lines", {}).items():
            lines[name] = {
                "color": getattr(style, colour, colour),
                "mec": style.INK,
                "mew": 0.4,
                **line,
            }
        handles = [Line2D([], [], label=name, **lines[name]) for name in names]
        title, rows = f"Figure {number}: {page['title']}", page.get("rows", 1)
        with style.picture(stem.with_suffix(".png"), title, handles, page["height"]) as figure:
            grid = figure.subplots(rows, len(panels) // rows, squeeze=False)
            for axes, (heading, series) in zip(grid.flat, panels.items(), strict=True):
                axes.set_title(heading, size=9, color=style.QUIET)
                axes.set(**page["axes"])
                style.lighten(axes)
                for name, points in series.items():
                    axes.plot(*points.T, **lines[name])
        write_csv(
            [
                {"panel": heading, "series": name, "x": x, "y": y}
                for heading, series in panels.items()
                for name, points in series.items()
                for x, y in points[np.isfinite(points).all(1)].tolist()
            ],
            stem.with_suffix(".csv"),
        )
        return f"## {title}\n\n{page['notes'].format(**numbers)}"

    @abstractmethod
    def _panels(self) -> Panels: ...


class Figure10(Drawing):
    """One term of PPO's objective against the probability ratio, for either sign of the advantage."""

    def _panels(self) -> Panels:
        env = ConeTrackEnv([shipped_track("train_1")], num_envs=2)
        ppo = PPO(env)
        rows = ppo.policy(env.reset()).detach().set("value_target", torch.zeros(2, 1))
        log_prob, panels, clipped = rows["action_log_prob"], {}, []
        for sign, title in ((-1.0, "A < 0"), (1.0, "A > 0")):
            points = []
            for ratio in RATIOS.tolist():
                # The loss is the mean of two terms; the second one has the ratio 1 and the opposite
                # advantage.
                old = (log_prob - torch.tensor([math.log(ratio), 0.0])).requires_grad_()
                rows["action_log_prob"], rows["advantage"] = old, torch.tensor([[sign], [-sign]])
                losses = ppo.losses(rows)
                slope = torch.autograd.grad(losses["loss_objective"], old)[0]
                losses = losses.detach()
                # Standardised, the advantages are 1 / sqrt(2) and its opposite.
                gain = sign - 2 * math.sqrt(2) * float(losses["loss_objective"])
                points.append((2 * float(losses["mean_ratio"]) - 1, gain, float(slope[0])))
            term, slopes = np.split(np.array(points), [2], axis=1)
            clipped.append(term[slopes[:, 0] == 0])
            panels[title] = {
                "one term": term,
                "clipped": clipped[-1],
                "r = 1": np.array([[1.0, sign]]),
            }
        return panels, {"low": clipped[0][:, 0].max(), "high": clipped[1][:, 0].min()}


class OnTheWay(Drawing):
    """A moment of the guide's drive on a shipped track, after some `seconds`; the car faces up, positions are in m."""

    def __init__(self, track: str = "train_1", seconds: float = 10.0) -> None:
        check_range(0, 60, seconds=seconds)
        self.track, self.seconds = shipped_track(track), seconds

    @torch.no_grad()
    def _drive(self) -> tuple[ConeTrackEnv, Tensor, Tensor, dict[str, Any]]:
        """Return the env, its visible cones [1, 2, K, 2], their number [1, 2], and the numbers in the notes."""
        env, guide = ConeTrackEnv([self.track], num_envs=1), SplineGuide()
        state = env.reset()
        for _ in range(round(self.seconds * env.rate)):
            state = step_mdp(env.step(guide(state)))
        return (
            env,
            state["cones"],
            state["cone_count"],
            {"track": self.track.name, "seconds": self.seconds},
        )


class Figure19(OnTheWay):
    """The simulator: a car on a track, the cones that it detects, and its estimates of both boundaries."""

    def _panels(self) -> Panels:
        env, cones, count, numbers = self._drive()
        frame = Frame(env.pose.double())
        around = {"left cones": self.track.left, "right cones": self.track.right}
        around["middle"] = resample(self.track.middle(), 1.0)
        series = {
            name: _facing_up(frame.to_car(torch.tensor(points.T)))
            for name, points in around.items()
        }
        seen = np.concatenate(list(_visible(cones[0], count[0]).values()))
        series["detected"] = np.stack([0 * seen, seen, seen + np.nan], 1).reshape(-1, 2)
        for side, samples in zip(
            SIDES, frame.to_car(env.samples.double())[..., 0].unbind(2), strict=True
        ):
            series[f"estimate of the {side} boundary"] = _facing_up(samples)
        numbers |= {"left": int(count[0, 0]), "right": int(count[0, 1])}
        return {"": {**series, "car": np.zeros((1, 2))}}, numbers


class Figure21(Drawing):
    """The cones of the first four training tracks."""

    def _panels(self) -> Panels:
        tracks = shipped_tracks("train")[:4]
        panels = {
            track.name: {"left cones": track.left, "right cones": track.right} for track in tracks
        }
        return panels, {
            "lengths": ", ".join(f"{track.name} {track.length:.1f} m" for track in tracks)
        }


class Figure26(Drawing):
    """A scan of the simulated robot's LiDAR, and the cones that the robot detects in it; the robot faces up, in m."""

    def _panels(self) -> Panels:
        drive, perception = simulated_drive("both", SEED), Perception(simulated_cone_classifier())
        ranges, angles = drive.ranges[[SCAN]].numpy(), drive.angles.numpy()
        points = points_of(ranges, angles, perception.range_min, RANGE_MAX)
        cones, count = map(torch.from_numpy, perception(ranges, angles))
        series = {**_visible(cones[0] / perception.scale, count[0]), "robot": np.zeros((1, 2))}
        series["LiDAR points"] = _facing_up(torch.from_numpy(np.stack([points.x, points.y])))
        counts = {name.split()[0]: len(of_name) for name, of_name in series.items()}
        return {"": series}, {
            "scan": SCAN,
            "sight": perception.range_max,
            "side": perception.bearing_max,
            **counts,
        }


class Figure30(Drawing):
    """The steering angle that the guide advises (equation 103) against the bearing of its target, by its distance."""

    def _panels(self) -> Panels:
        guide, alpha = SplineGuide(), torch.linspace(-60, 60, 121, dtype=torch.float64)
        ahead = torch.stack([alpha.deg2rad().cos(), alpha.deg2rad().sin()])
        angles = {d: guide.max_steering * guide._pursuit(d * ahead) for d in DISTANCES}
        series = {
            f"d = {d:g} m": torch.stack([alpha, beta], 1).numpy() for d, beta in angles.items()
        }
        return {"": series}, {
            "greatest": ", ".join(f"{beta[-1]:.1f}° at {d:g} m" for d, beta in angles.items())
        }


class Figure31(OnTheWay):
    """The guide's path in three steps: midpoints of pairs of cones, a spline through them, and targets on it."""

    def _panels(self) -> Panels:
        _, cones, count, numbers = self._drive()
        plan = SplineGuide().plan(cones, count)
        pairs = int(plan.midpoint_count)
        seen = {**_visible(cones[0], count[0]), "car": np.zeros((1, 2))}
        midpoints = {"midpoints of pairs": _facing_up(plan.midpoints[:, :pairs, 0])}
        spline = {"smoothing spline": _facing_up(plan.path.equidistant(SPLINE_POINTS)[..., 0])}
        # A shorter path repeats its last target.
        targets = {"targets": np.unique(_facing_up(plan.targets[..., 0]), axis=0)}
        panels = {"midpoints": seen | midpoints, "spline": seen | midpoints | spline}
        numbers |= {"pairs": pairs, "targets": len(targets["targets"])}
        return panels | {"targets": seen | spline | targets}, numbers


def _facing_up(points: Tensor) -> Array:
    """Rotate points [2, N] from the car's frame (x ahead, y left) to the picture's (y ahead); returns [N, 2]."""
    return torch.stack([-points[1], points[0]], 1).double().numpy()


def _visible(cones: Tensor, count: Tensor) -> dict[str, Array]:
    """Return the cones of either side, facing up, of padded cones [2, K, 2] and their number [2]."""
    real = zip(SIDES, cones, count.tolist(), strict=True)
    return {f"{side} cones": _facing_up(of_side[:number].t()) for side, of_side, number in real}
