"""Draw the view of a car in the cone world, and its guide's plan, at four moments of a drive.

There are four moments of the guide's drive. The car faces up in each panel. Cones within 7 m and 60
degrees of the heading are in sight. A smoothing spline through the cones of a side estimates that
boundary; five samples of each are the observation (distance and bearing). With fewer than two cones
in sight, the last samples are remembered as places in the world. The guide pairs left and right
cones into midpoints, fits a smoother spline through them and steers for a target on it.

    python -m coil_paper.figures.world [OUTPUT FOLDER]
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.patches import Patch, PathPatch, Polygon
from matplotlib.path import Path as Outline
from tensordict import TensorDictBase
from torchrl.envs.utils import step_mdp

from coil_paper.figures import ego_view
from coil_paper.figures.ego_view import CONE_COLOURS, LINE_COLOURS, Array, facing_up, marker, rows
from coil_rl import ConeTrackEnv, SplineGuide, Track
from coil_rl.envs import HALF_FIELD_OF_VIEW, SAMPLES, SIDES, SIGHT, Frame, shipped_track
from coil_rl.report import style

TRACK = "test_3"
MOMENTS = {"straight": 10.5, "right bend": 17.5, "left bend": 4.75, "left boundary lost": 5.33}  # s
CAR = np.array([[0.7, 0.0], [-0.5, 0.42], [-0.25, 0.0], [-0.5, -0.42]])  # m
EDGE: Any = {"mec": style.INK, "mew": 0.5}


@torch.no_grad()
def draw_moments(panels: list[Axes]) -> None:
    """Let the guide drive, and draw a panel at each moment."""
    track = shipped_track(TRACK)
    env, guide = ConeTrackEnv([track], num_envs=1), SplineGuide()
    moments = {round(seconds * env.rate): name for name, seconds in MOMENTS.items()}
    state = env.reset()
    for step in range(max(moments) + 1):
        state = guide(state)
        if step in moments:
            axes = panels[list(MOMENTS).index(moments[step])]
            axes.set_title(
                f"{moments[step]}, after {step / env.rate:.2f} s",
                size=9,
                loc="left",
                color=style.QUIET,
            )
            draw_moment(axes, track, env, guide, state)
        state = step_mdp(env.step(state))


def draw_moment(
    axes: Axes, track: Track, env: ConeTrackEnv, guide: SplineGuide, state: TensorDictBase
) -> None:
    """Draw the track, the view and the guide's plan of the car."""
    frame = Frame(env.pose.double())
    cones, count = state["cones"], state["cone_count"]

    def local(points: Array) -> Array:
        return facing_up(rows(frame.to_car(torch.tensor(points.T))))

    ego_view.make_panel(axes, sideways=6.7, behind=1.3, ahead=7.6)
    # The inner ring becomes a hole if the two run in opposite directions.
    rings = [local(track.boundary("left", 0.1)), local(track.boundary("right", 0.1))[::-1]]
    surface = Outline.make_compound_path(
        *(Outline(np.vstack([ring, ring[:1]]), closed=True) for ring in rings)
    )
    axes.add_patch(PathPatch(surface, fc=style.ASPHALT, ec=style.KERB, lw=0.6, zorder=1))
    ego_view.draw_field_of_view(axes, SIGHT, HALF_FIELD_OF_VIEW)
    boundary = env.boundaries.fit(cones.permute(3, 2, 1, 0), count.t())
    samples = frame.to_car(env.samples)[..., 0].permute(2, 1, 0).double().numpy()
    for side, name in enumerate(SIDES):
        visible = facing_up(rows(cones[0, side, : count[0, side]].t()))
        axes.plot(
            *local(getattr(track, name)).T,
            "o",
            ms=5,
            mfc=style.BACKGROUND,
            mec=CONE_COLOURS[side],
            mew=1.1,
            zorder=3,
        )
        axes.plot(*visible.T, "o", ms=7.5, mfc=CONE_COLOURS[side], zorder=4, **EDGE)
        if env.sampled[side, 0] > 0:
            ego_view.draw_boundary(axes, boundary, side, len(visible) > 1, samples[side])
            number_samples(axes, facing_up(samples[side]), side)
    ego_view.draw_plan(axes, guide.plan(cones, count))
    axes.add_patch(Polygon(facing_up(CAR), fc=style.INK, ec=style.BACKGROUND, lw=0.6, zorder=9))
    ego_view.draw_advice(axes, float(state["action"]) * guide.max_steering, length=2.0)


def number_samples(axes: Axes, samples: Array, side: int) -> None:
    """Write the numbers of the first and the last sample of a side outside of the boundary."""
    along = np.gradient(samples, axis=0)
    outward = (
        np.stack([-along[:, 1], along[:, 0]], 1)
        * (1, -1)[side]
        / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    )
    for index in (0, SAMPLES - 1):
        axes.annotate(
            str(SAMPLES * side + index + 1),
            samples[index],
            8 * outward[index],
            textcoords="offset points",
            ha="center",
            va="center",
            size=7.5,
            color=LINE_COLOURS[side],
            annotation_clip=True,
            zorder=10,
        )


def main() -> None:
    """Draw world.png."""
    path = ego_view.output_folder(__doc__) / "world.png"
    handles = [
        marker("o", "left cone in sight", 7, mfc=CONE_COLOURS[0], **EDGE),
        marker("o", "right cone in sight", 7, mfc=CONE_COLOURS[1], **EDGE),
        marker("o", "cone out of sight", 5, mfc=style.BACKGROUND, mec=CONE_COLOURS[1]),
        Patch(fc=style.BACKGROUND, ec=style.QUIET, lw=0.8, label="field of view"),
        marker("D", "remembered sample", 4.2, mfc=style.BACKGROUND, mec=LINE_COLOURS[0]),
        *ego_view.common_handles(),
    ]
    with style.picture(
        path, f"A car's view and its guide's advice ({TRACK})", handles, height=6.25
    ) as figure:
        draw_moments(list(figure.subplots(2, 2).flat))
    print(path)


if __name__ == "__main__":
    main()
