"""What a car of the cone world sees at some moments of the guide's drive, and what the guide makes of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs.utils import step_mdp
from tqdm import trange

from coil_rl.envs import ConeTrackEnv, Track
from coil_rl.envs.sight import Frame
from coil_rl.envs.track import SIDES
from coil_rl.errors import UserError
from coil_rl.guides import SplineGuide
from coil_rl.reproduce.facing_up import FINE, places_of, rows

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Look:
    """One moment; all places are in m in the car's frame (x ahead, y left), those of two sides left first.

    Attributes:
        name: of the moment.
        seconds: of the drive.
        cones: all that stand on the track, [N, 2].
        boundaries: of the track itself, [P, 2].
        seen: cones in sight, nearest first, [n, 2].
        estimate: the boundary as the car estimates it, [P, 2]; no point where fewer than two cones are in sight.
        samples: the five of each side that the observation tells of, [2, 5, 2].
        known: whether a side was ever seen, [2].
        observation: [20].
        plan: of the guide, see `places_of`.
        advice: degrees.
        steering: degrees, now in force.
    """

    name: str
    seconds: float
    cones: Sequence[Array]
    boundaries: Sequence[Array]
    seen: Sequence[Array]
    estimate: Sequence[Array]
    samples: Array
    known: NDArray[np.bool_]
    observation: Array
    plan: Mapping[str, Array]
    advice: float
    steering: float

    @property
    def fresh(self) -> list[bool]:
        """Whether each side's samples are of now, and not remembered."""
        return [len(curve) > 0 for curve in self.estimate]


@torch.no_grad()
def looks(track: Track, moments: Mapping[str, float]) -> list[Look]:
    """Let the guide drive, and look at some moments.

    Args:
        track: where.
        moments: s since the start, by name.

    Raises:
        UserError: if the drive ends before one of them.
    """
    env, guide = ConeTrackEnv([track], num_cars=1), SplineGuide()
    steps = {name: round(seconds * env.rate) for name, seconds in moments.items()}
    found: dict[str, Look] = {}
    state = env.reset()
    for step in trange(max(steps.values()) + 1, desc="drive", unit="step", leave=False, delay=1):
        state = guide(state)
        for name in (name for name, at in steps.items() if at == step):
            found[name] = _look(name, step / env.rate, track, env, guide, state)
        state = step_mdp(env.step(state))
        if state["done"].all() and len(found) < len(moments):
            over = f"{(step + 1) / env.rate:.1f} s"
            raise UserError(f"the guide's drive on {track.name} is over after {over}; give moments before that")
    return [found[name] for name in moments]


def _look(
    name: str, seconds: float, track: Track, env: ConeTrackEnv, guide: SplineGuide, state: TensorDictBase
) -> Look:
    frame = Frame(env.pose.double())
    cones, count = state["cones"], state["cone_count"]
    boundary = env.fit(cones.permute(3, 2, 1, 0), count.t()).equidistant(FINE)

    def from_car(points: Array) -> Array:
        return rows(frame.to_car(torch.tensor(points.T)))

    return Look(
        name=name,
        seconds=seconds,
        cones=[from_car(ring) for ring in (track.left, track.right)],
        boundaries=[from_car(track.boundary(side, 0.1)) for side in SIDES],
        seen=[rows(cones[0, side, :n].t()) for side, n in enumerate(count[0].tolist())],
        estimate=[rows(boundary[:, : FINE if n > 1 else 0, side, 0]) for side, n in enumerate(count[0].tolist())],
        samples=frame.to_car(env.samples)[..., 0].permute(2, 1, 0).double().numpy(),
        known=(env.sampled[:, 0] > 0).numpy(),
        observation=state["observation"][0].double().numpy(),
        plan=places_of(guide.plan(cones, count)),
        advice=float(state["action"]) * guide.max_steering,
        steering=float(state["steering"]) * guide.max_steering,
    )
