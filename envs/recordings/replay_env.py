"""Recorded drives of a robot as an env: what would a policy have steered, scan by scan?"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from coil_rl.envs.recordings.reading import Recording, read_recording
from coil_rl.envs.reward import HISTORY, recent_mean
from coil_rl.envs.robot.boundary_memory import BoundaryMemory
from coil_rl.envs.sight import SAMPLES, SIGHT, Frame

Perceive = Callable[[NDArray[np.float32], NDArray[np.float64]], tuple[Any, Any]]
AnyPath = str | os.PathLike[str]


class McapReplayEnv(EnvBase):
    """Recordings side by side, each replayed from its first scan to its last whatever the agent does.

    Reads `action` [B, 1], the steering angle as a fraction of 80 degrees. Writes what an agent or a guide of
    `ConeTrackEnv` reads: `observation` [B, 20], `cones` [B, 2, K, 2] in the scale of the simulation, `cone_count`
    [B, 2], `steering` [B, 1] the action now in force; `omega` [B, 1] radians/s, how fast that turns the robot;
    `reward`, `done`, `terminated`, `truncated` [B, 1]; and under `info`: `scan` (which one is shown), `time` (s since
    the first one), `pose` [B, 3] (m, m, radians, since the first scan, if the recording tells), `valid` [B, 2] (whether
    each side was seen in this scan), `smoothness` |a - a_avg| and `reward`, whose only term is `smooth`, for a replay
    cannot know what another steering had led to.

    A step takes the action for the scan that was shown and shows the next one, so a recording of N scans takes N
    actions; then the episode is truncated, and the last scan is shown once more.

    Args:
        recordings: one or several, B of them: MCAP files, rosbag2 directories, or what `read_recording` made of them.
        perception: from scans, [N, P] m and infinite where nothing came back, and the bearings [P] of their points in
            radians, to cones in the car's frame, [N, 2, K, 2] m times `scale`, left side first and nearest first, and
            how many there are, [N, 2]. It is asked once for all scans of a recording, or once for those whose points
            have the same bearings.
        scan: topic of the LiDAR.
        odometry: topic of the odometry, or None.
        command: topic of the commands that the robot was given, or None.
        strict: refuse a recording that is cut off.
        remembered: what becomes of a boundary while it is not seen. "held": its numbers stay as they were, as with a
            robot that does not know how it moves. "moved": it stays where it is while the robot moves, by its odometry
            or else its commands; see `Recording.poses`.
        spline: of the boundary estimate, "cubic" (smoothing) or "quadratic" (interpolating).
        smoothing: lambda of the cubic smoothing spline, m^3.
        smooth: weight of the reward, per unit of |a - mean of the last 20 actions|.
        kept_cones: K.
        scale: metres of the simulation in one of the robot's.
        sight: m in the scale of the simulation, as far as cones are seen.
        speed: m/s of the robot.
        car_length: m, its L.
        max_steering: degrees of an action of 1.
        device: where everything lives.

    Raises:
        RecordingError: for a recording that cannot be used, in one sentence.
        ValueError: for another value outside its range, naming it.

    Example:
        >>> from coil_rl.envs.recordings.reading import Recording
        >>> times, ones = np.arange(5) * 10**8, np.ones(5)
        >>> drive = Recording("drive", False, times, times, np.ones((5, 360), np.float32), ones * 360, -ones, ones / 60)
        >>> env = McapReplayEnv(drive, lambda ranges, angles: (np.zeros((5, 2, 16, 2)), np.zeros((5, 2))))
        >>> env.rollout(100)["next", "observation"].shape
        torch.Size([1, 5, 20])
    """

    steps: Tensor
    history: Tensor
    first: Tensor
    length: Tensor
    cones: Tensor
    count: Tensor
    samples: Tensor
    valid: Tensor
    pose: Tensor
    seconds: Tensor

    def __init__(
        self,
        recordings: AnyPath | Recording | Sequence[AnyPath | Recording],
        perception: Perceive,
        *,
        scan: str = "/scan",
        odometry: str | None = "/odom",
        command: str | None = "/cmd_vel",
        strict: bool = False,
        remembered: Literal["held", "moved"] = "held",
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 0.1,
        smooth: float = -0.1,
        kept_cones: int = 16,
        scale: float = 7.0,
        sight: float = SIGHT,
        speed: float = 0.15,
        car_length: float = 2 / 7,
        max_steering: float = 80.0,
        device: torch.device | str = "cpu",
    ) -> None:
        if remembered not in ("held", "moved"):
            raise ValueError(f"remembered={remembered!r} must be one of held, moved")
        positive = {
            "kept_cones": kept_cones, "scale": scale, "sight": sight, "speed": speed, "car_length": car_length,
            "max_steering": max_steering,
        }  # fmt: skip
        for name, value in positive.items():
            if not 0 < value < math.inf:
                raise ValueError(f"{name}={value} must be a finite number above 0")
        if max_steering > 90:
            raise ValueError(f"max_steering={max_steering} must be at most 90 degrees")
        if not math.isfinite(smooth):
            raise ValueError(f"smooth={smooth} must be a finite number")
        given = [recordings] if isinstance(recordings, (str, os.PathLike, Recording)) else list(recordings)
        if not given:
            raise ValueError("recordings is empty; give at least one MCAP file or rosbag2 directory")
        self.recordings = [
            one if isinstance(one, Recording) else read_recording(one, scan, odometry, command, strict=strict)
            for one in given
        ]
        super().__init__(device=torch.device(device), batch_size=torch.Size([len(self.recordings)]))
        self.kept_cones, self.scale, self.moves = kept_cones, scale, remembered == "moved"
        self.smooth, self.max_steering = smooth, math.radians(max_steering)
        self.turn_rate = speed / car_length
        self.memory = BoundaryMemory(len(given), spline, smoothing, sight=sight)
        self._load(perception)
        self._declare_specs()
        self.register_buffer("steps", torch.zeros(len(given), dtype=torch.int64))
        self.register_buffer("history", torch.zeros(HISTORY, len(given)))
        self.to(self.device)

    def _load(self, perception: Perceive) -> None:
        """Lay all recordings end to end, [T] scans in one tensor a quantity."""
        seen = [_perceived(recording, perception, self.kept_cones) for recording in self.recordings]
        poses = [recording.poses() for recording in self.recordings]
        length = torch.tensor([len(pose) for pose in poses])
        for name, value in {
            "cones": np.concatenate([cones for cones, _ in seen]),
            "count": np.concatenate([count for _, count in seen]),
            "pose": np.concatenate([_from_start(pose) for pose in poses]).astype(np.float32),
            "seconds": np.concatenate([recording.seconds for recording in self.recordings]).astype(np.float32),
        }.items():
            self.register_buffer(name, torch.from_numpy(value), persistent=False)
        # All at once here is many times as fast as one after the other while the recording is replayed.
        samples, valid = self.memory.estimate(self.cones, self.count)
        self.register_buffer("samples", samples, persistent=False)
        self.register_buffer("valid", valid, persistent=False)
        self.register_buffer("length", length, persistent=False)
        self.register_buffer("first", length.cumsum(0) - length, persistent=False)

    def _declare_specs(self) -> None:
        rows, device = self.batch_size, self.device

        def real(*shape: int) -> Unbounded:
            return Unbounded((*rows, *shape), dtype=torch.float32, device=device)

        def whole(*shape: int) -> Unbounded:
            return Unbounded((*rows, *shape), dtype=torch.int64, device=device)

        def flags(count: int) -> Binary:
            return Binary(count, shape=(*rows, count), dtype=torch.bool, device=device)

        def bounded(*shape: int) -> Bounded:
            return Bounded(-1, 1, (*rows, *shape), dtype=torch.float32, device=device)

        info = Composite(
            scan=whole(1), time=real(1), pose=real(3), valid=flags(2), smoothness=real(1),
            reward=Composite(smooth=real(1), shape=rows), shape=rows,
        )  # fmt: skip
        self.observation_spec = Composite(
            observation=bounded(4 * SAMPLES), cones=real(2, self.kept_cones, 2), cone_count=whole(2),
            steering=bounded(1), omega=real(1), info=info, shape=rows,
        )  # fmt: skip
        self.action_spec = bounded(1)
        self.reward_spec = real(1)
        self.done_spec = Composite(
            {key: flags(1) for key in ("done", "terminated", "truncated")}, shape=rows, device=device
        )

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is drawn."""

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        given = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones_like(self.steps, dtype=torch.bool) if given is None else given.view(-1)
        self.steps, self.history = self.steps.masked_fill(mask, 0), self.history.masked_fill(mask, 0)
        before = self.memory.samples, self.memory.known
        self.memory.reset(mask)
        seen = self._see()
        # Who is not reset has taken in this scan already.
        now = self.memory.samples, self.memory.known
        self.memory.samples, self.memory.known = (torch.where(mask, x, y) for x, y in zip(now, before, strict=True))
        return self._tensordict(seen, torch.zeros_like(self.history[0]))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].detach().view(-1).clamp(-1, 1)
        roughness = (action - recent_mean(self.history)).abs()
        self.history = torch.cat([action.unsqueeze(0), self.history[:-1]])
        before = self._shown()
        self.steps = self.steps + 1
        if self.moves:
            then, now = Frame(self._place(before)), Frame(self._place(self._shown()))
            self.memory.samples = now.to_car(then.to_world(self.memory.samples))
        out = self._tensordict(self._see(), roughness)
        out["reward"] = out["info", "reward", "smooth"]
        over = (self.steps >= self.length).unsqueeze(-1)
        out["done"], out["truncated"], out["terminated"] = over, over.clone(), torch.zeros_like(over)
        return out

    def _shown(self) -> Tensor:
        """Which of all scans each row shows now [B]."""
        return self.first + torch.minimum(self.steps, self.length - 1)

    def _place(self, scan: Tensor) -> Tensor:
        """The poses [3, B] at scans, in the scale of the simulation."""
        x, y, heading = self.pose.index_select(0, scan).unbind(1)
        return torch.stack([x * self.scale, y * self.scale, heading])

    def _see(self) -> dict[str, Tensor]:
        """What the scans show, and what is remembered from before."""
        shown = self._shown()
        cones, count = self.cones.index_select(0, shown), self.count.index_select(0, shown)
        observation, valid = self.memory.remember(
            self.samples.index_select(3, shown), self.valid.index_select(1, shown)
        )
        return {"observation": observation, "cones": cones, "cone_count": count, "valid": valid}

    def _tensordict(self, seen: dict[str, Tensor], roughness: Tensor) -> TensorDict:
        shown, steering = self._shown(), self.history[0].unsqueeze(-1)
        info = {
            "scan": (shown - self.first).unsqueeze(-1),
            "time": self.seconds.index_select(0, shown).unsqueeze(-1),
            "pose": self.pose.index_select(0, shown),
            "valid": seen["valid"],
            "smoothness": roughness.unsqueeze(-1),
            "reward": TensorDict({"smooth": self.smooth * roughness.unsqueeze(-1)}, self.batch_size),
        }
        entries: dict[str, Any] = {key: seen[key] for key in ("observation", "cones", "cone_count")}
        entries |= {"steering": steering, "omega": (steering * self.max_steering).sin() * self.turn_rate}
        entries |= {"info": TensorDict(info, self.batch_size, device=self.device)}
        return TensorDict(entries, self.batch_size, device=self.device)


def _from_start(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses [N, 3] as seen from the first of them; small numbers, whatever the origin of the odometry is."""
    x, y, heading = (poses - poses[0]).T
    cos, sin = np.cos(poses[0, 2]), np.sin(poses[0, 2])
    return np.stack([cos * x + sin * y, cos * y - sin * x, heading], axis=1)


def _perceived(recording: Recording, perception: Perceive, kept: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """The cones [N, 2, K, 2] m and their counts [N, 2] in all scans of a recording."""
    scans = len(recording.ranges)
    cones, count = np.zeros((scans, 2, kept, 2), np.float32), np.zeros((scans, 2), np.int64)
    layouts = np.stack([recording.points, recording.angle_min, recording.angle_increment], axis=1)
    for layout in np.unique(layouts, axis=0):
        rows = np.flatnonzero((layouts == layout).all(axis=1))
        points = int(layout[0])
        found, real = perception(recording.ranges[rows, :points], recording.angles(rows[0])[:points])
        found, real = np.asarray(found), np.asarray(real)
        if found.ndim != 4 or found.shape[:2] + found.shape[3:] != (len(rows), 2, 2) or real.shape != (len(rows), 2):
            raise ValueError(
                f"perception made cones {found.shape} and counts {real.shape} of {len(rows)} scans; it must make "
                f"[{len(rows)}, 2, K, 2] and [{len(rows)}, 2]"
            )
        nearest = min(kept, found.shape[2])
        cones[rows, :, :nearest], count[rows] = found[:, :, :nearest], np.minimum(real, nearest)
    return cones, count
