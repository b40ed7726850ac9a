"""Replay of recorded robot drives as an env.

A policy gets the scans of a recording one after the other and chooses an action for each, which has
no effect on the drive. This shows what a policy would do on a real robot before it is let loose.
"""

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from coil_rl.envs.recordings.cautions import about_demonstrations, cautions_about
from coil_rl.envs.recordings.folders import RecordingError, files_of
from coil_rl.envs.recordings.mcap_files import read_messages
from coil_rl.envs.recordings.reading import read_recording
from coil_rl.envs.recordings.recording import STANDS, Recording
from coil_rl.envs.reward import HISTORY, recent_mean
from coil_rl.envs.robot.perception import BoundaryMemory, Perception
from coil_rl.envs.seeded_env import declare_specs
from coil_rl.envs.sight import SIGHT
from coil_rl.ranges import Count, Degrees, Interval, Positive, SeenCones, checked

Perceive = Callable[[NDArray[np.float32], NDArray[np.float64]], tuple[Any, Any]]
AnyPath = str | os.PathLike[str]


@checked
class McapReplayEnv(EnvBase):
    """Recordings side by side, each replayed from its first to its last scan.

    Reads `action` [B, 1], the steering angle as a fraction of `max_steering`. Writes the entries of
    `ConeTrackEnv`: `observation` [B, 20], `cones` [B, 2, K, 2] in the scale of the cone world,
    `cone_count` [B, 2], `steering` [B, 1], `reward`, `done`, `terminated`, `truncated` [B, 1];
    `omega` [B, 1] radians/s, the turn rate of the robot at that steering; and under `info`: `scan`
    (its index), `time` (s since the first scan), `pose` [B, 3] (m, m, radians, relative to the
    first scan), `valid` [B, 2] (whether each side is valid in this scan), `smoothness` |a - a_avg|
    and `reward`. The only term of the reward is `smooth`, as a replay cannot show the effect of
    other actions.

    For imitation it also writes under `info`: `recorded` [B, 1], the recorded steering as an action
    (0 where it is unknown); `stale`, whether no command is recent enough to belong to the scan;
    `standing`, whether the robot was told to stand or to drive backwards; `usable`, whether the
    recorded steering is to be learned (it is neither, and the scan is seen for the first time); and
    `track`, the number of the recording.

    A step takes the action for the current scan and moves on to the next scan, so a recording of N
    scans takes N actions; then the episode is truncated, and the last scan is repeated.

    Args:
        recordings: recordings or a single one: MCAP files, rosbag2 folders, or `Recording`s.
        perception: maps scans [N, P] m (infinite without a return) and bearings [P] radians to
            cones [N, 2, K, 2] in the car's frame, m in the scale of the cone world, left side
            first, nearest first; and their number [N, 2]. Called once for all scans of a recording
            with equal bearings.
        num_envs: B; row i replays recording i modulo their number. None for one row each.
        scan: topic of the LiDAR.
        odometry: topic of the odometry, or None; ignored if the recording does not have it.
        command: topic of the commands, or None; ignored if the recording does not have it.
        frame: of the scanner, if several send scans on one topic; None for the first one.
        strict: raise for a recording that is cut off or damaged, instead of a warning.
        spline: of the boundary estimate, "cubic" (smoothing) or "quadratic" (least-squares
            parabola).
        smoothing: lambda of the cubic smoothing spline, m^3 in the scale of the cone world.
        smooth: weight of the reward per unit of |a - mean of the last 20 actions|.
        kept_cones: K, the nearest cones of each side that are written.
        sight: m, range of view in the scale of the cone world; None for that of the perception,
            and `SIGHT` for one that is no `Perception`.
        speed: m/s, of the robot.
        car_length: m, distance between the axles of the robot.
        max_steering: degrees of an action of 1, at most 90.
        device: of all tensors.

    Raises:
        RecordingError: for a recording that cannot be used.
        ValueError: for a value outside its range, and without a recording.
    """

    reacts = False  # nothing that a policy does changes what comes next

    @staticmethod
    def whole_pass(arguments: Mapping[str, Any]) -> tuple[int, int]:
        """Return how many recordings there are, and how many scans the longest has, at least 1.

        One that cannot be read counts as one scan: what is wrong is said when the env is made.

        Args:
            arguments: of the constructor; `recordings` and `scan` are read.
        """
        recordings = arguments["recordings"]
        paths = [recordings] if isinstance(recordings, (str, Path)) else list(recordings or ())
        topic = str(arguments.get("scan", "/scan"))
        return max(1, len(paths)), max([_scans(str(path), topic) for path in paths], default=1)

    @property
    def rate(self) -> float:
        """Scans per second: the median of all recordings; NaN where there are single scans only."""
        turns = [each.turn for each in self.recordings if each.turn]
        return 1 / float(np.median(turns)) if turns else math.nan

    def scans_of(self, number: int) -> slice:
        """Return the scans of a recording among all scans."""
        lengths = [len(each.ranges) for each in self.recordings[: number + 1]]
        return slice(sum(lengths[:-1]), sum(lengths))

    def cautions(self, number: int) -> list[str]:
        """Return what makes the meaning of a recording doubtful here, see `cautions_about`."""
        return cautions_about(self, number)

    def demonstrations(self) -> Iterator[str]:
        """Yield lines on what there is to learn; a `ValueError` if there is nothing."""
        return about_demonstrations(self)

    def __init__(
        self,
        recordings: AnyPath | Recording | Sequence[AnyPath | Recording] | None,
        perception: Perceive,
        *,
        num_envs: Count | None = None,
        scan: str = "/scan",
        odometry: str | None = "/odom",
        command: str | None = "/cmd_vel",
        frame: str | None = None,
        strict: bool = False,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 0.1,
        smooth: Annotated[float, Interval(ge=-1e6, le=1e6)] = -0.1,
        kept_cones: SeenCones = 16,
        sight: Positive | None = None,
        speed: Positive = 0.15,
        car_length: Positive = 2 / 7,
        max_steering: Degrees = 80.0,
        device: torch.device | str = "cpu",
    ) -> None:
        if sight is None:
            sight = perception.sight if isinstance(perception, Perception) else SIGHT
        if isinstance(recordings, (str, os.PathLike, Recording)):
            sources = [recordings]
        else:
            sources = list(recordings or ())
        if not sources:
            raise ValueError(
                "recordings is empty; give at least one MCAP file or rosbag2 folder: recording=FILE"
            )
        read = partial(
            read_recording,
            scan=scan,
            odometry=odometry,
            command=command,
            frame=frame,
            strict=strict,
        )
        self.recordings = [
            source if isinstance(source, Recording) else read(source) for source in sources
        ]
        rows = len(self.recordings) if num_envs is None else num_envs
        super().__init__(device=torch.device(device), batch_size=torch.Size([rows]))
        self.smooth, self.max_steering = smooth, math.radians(max_steering)
        self.speed, self.car_length = speed, car_length
        self.memory = BoundaryMemory(rows, spline, smoothing, sight=sight)
        self.perception = perception
        self._store_scans(kept_cones)
        numbers = torch.arange(rows)
        self.track: Tensor = nn.Buffer(numbers % len(self.recordings), persistent=False)
        scans = torch.tensor([len(each.ranges) for each in self.recordings])
        self.length: Tensor = nn.Buffer(scans[self.track], persistent=False)
        self.first: Tensor = nn.Buffer((scans.cumsum(0) - scans)[self.track], persistent=False)
        self.steps: Tensor = nn.Buffer(torch.zeros(rows, dtype=torch.int64))
        # How often the scans of a row were seen before, by the row itself or by an earlier one.
        self.passes: Tensor = nn.Buffer(numbers // len(self.recordings))
        self.history: Tensor = nn.Buffer(torch.zeros(HISTORY, rows))
        self.to(self.device)
        declare_specs(self, self._reset())

    def _store_scans(self, kept_cones: int) -> None:
        """Perceive all scans of all recordings, and keep what is known of them, end to end.

        Args:
            kept_cones: K.
        """
        known: Any = torch.cat([self._known_of(each, kept_cones) for each in self.recordings])
        # Much faster here, for all scans at once, than step by step.
        samples, valid = self.memory.estimate(known["cones"], known["cone_count"])
        self.samples: Tensor = nn.Buffer(samples, persistent=False)
        self.valid: Tensor = nn.Buffer(valid, persistent=False)
        self.known: TensorDictBase = known.to(self.device)

    def _known_of(self, recording: Recording, kept_cones: int) -> TensorDict:
        """Return what is known of each scan of a recording, [N], by the names of the entries."""
        cones, count = _perceive(recording, self.perception, kept_cones)
        angle = speed = np.full(len(recording.ranges), np.nan)
        if recording.commands is not None:
            angle, _, speed = recording.steering(self.speed, self.car_length)
        action = (angle / self.max_steering).clip(-1, 1).astype(np.float32)
        known = {
            "cones": cones,
            "cone_count": count,
            "pose": _from_start(recording.poses(self.car_length)).astype(np.float32),
            "time": recording.seconds.astype(np.float32),
            "recorded": np.nan_to_num(action),
            "stale": np.isnan(action),
            "standing": speed < STANDS,
        }
        return TensorDict(
            {name: torch.from_numpy(each) for name, each in known.items()}, len(cones)
        )

    def _set_seed(self, seed: int | None) -> None:
        """Do nothing: the env is deterministic."""

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones_like(self.steps, dtype=torch.bool) if mask is None else mask.view(-1)
        self.passes = self.passes + (mask & (self.steps > 0))
        self.steps = self.steps.masked_fill(mask, 0)
        self.history = self.history.masked_fill(mask, 0)
        self.memory.reset(mask)
        # Rows that are not reset perceive their scan again, which does not change their memory.
        return self._entries(torch.zeros_like(self.history[0]))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].detach().view(-1).clamp(-1, 1)
        roughness = (action - recent_mean(self.history)).abs()
        self.history = torch.cat([action.unsqueeze(0), self.history[:-1]])
        self.steps = self.steps + 1
        out = self._entries(roughness)
        out["reward"] = out["info", "reward", "smooth"]
        done = (self.steps >= self.length).unsqueeze(-1)
        out["done"], out["truncated"] = done, done.clone()
        out["terminated"] = torch.zeros_like(done)
        return out

    def _entries(self, roughness: Tensor) -> TensorDict:
        """Update the memory with the current scans; return the entries of a reset or a step.

        Args:
            roughness: [B], |a - mean of the last 20 actions|.
        """
        current = self.first + torch.minimum(self.steps, self.length - 1)
        known, steering = self.known[current], self.history[0].unsqueeze(-1)
        samples, valid = self.samples.index_select(3, current), self.valid.index_select(1, current)
        observation, valid = self.memory.remember(samples, valid)
        usable = ~known["stale"] & ~known["standing"] & (self.passes == 0)
        info = {
            "scan": (current - self.first).unsqueeze(-1),
            "time": known["time"].unsqueeze(-1),
            "pose": known["pose"],
            "valid": valid,
            "smoothness": roughness.unsqueeze(-1),
            "recorded": known["recorded"].unsqueeze(-1),
            "stale": known["stale"].unsqueeze(-1),
            "standing": known["standing"].unsqueeze(-1),
            "usable": (usable & (self.steps < self.length)).unsqueeze(-1),
            "track": self.track.unsqueeze(-1),
            "reward": TensorDict({"smooth": self.smooth * roughness.unsqueeze(-1)}, known.shape),
        }
        entries: dict[str, Any] = {
            "observation": observation,
            "cones": known["cones"],
            "cone_count": known["cone_count"],
            "steering": steering,
            "info": TensorDict(info, known.shape, device=self.device),
            "omega": (steering * self.max_steering).sin() * (self.speed / self.car_length),
        }
        return TensorDict(entries, known.shape, device=self.device)


def _scans(path: str, topic: str) -> int:
    """Return the number of messages on the topic of the scans, at least 1."""
    try:
        stats = [file.stat() for file in files_of(Path(path)).files]
        states = tuple((each.st_size, each.st_mtime_ns) for each in stats)
        return max(1, _messages(Path(path).resolve(), topic, states))
    except (OSError, RecordingError):
        return 1


@lru_cache(maxsize=256)
def _messages(path: Path, topic: str, states: tuple[tuple[int, int], ...]) -> int:
    """Return the number of messages on a topic.

    Args:
        path: absolute; a relative one is another recording in another working directory.
        states: sizes and times of change of the files, which only keep the memory true.
    """
    return len(read_messages(path, [topic]).messages[topic])


def _from_start(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses [N, 3] relative to the first one."""
    x, y, heading = (poses - poses[0]).T
    cos, sin = np.cos(poses[0, 2]), np.sin(poses[0, 2])
    return np.stack([cos * x + sin * y, cos * y - sin * x, heading], axis=1)


def _perceive(
    recording: Recording, perception: Perceive, kept_cones: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the cones [N, 2, K, 2] m of all scans of a recording, and their number [N, 2].

    Args:
        perception: called once for all scans with equal bearings.
        kept_cones: K.
    """
    scans = len(recording.ranges)
    all_cones = np.zeros((scans, 2, kept_cones, 2), np.float32)
    all_counts = np.zeros((scans, 2), np.int64)
    layouts = np.stack([recording.points, recording.angle_min, recording.angle_increment], axis=1)
    for layout in np.unique(layouts, axis=0):
        rows = np.flatnonzero((layouts == layout).all(axis=1))
        points = int(layout[0])
        ranges, angles = recording.ranges[rows, :points], recording.angles(rows[0])[:points]
        cones, count = map(np.asarray, perception(ranges, angles))
        # Any number of cones per side will do.
        fits = cones.ndim == 4 and cones.shape[:2] + cones.shape[3:] == (len(rows), 2, 2)
        if not fits or count.shape != (len(rows), 2):
            raise ValueError(
                f"perception returned cones {cones.shape} and counts {count.shape} for {len(rows)} "
                f"scans; it must return [{len(rows)}, 2, K, 2] and [{len(rows)}, 2]"
            )
        nearest = min(kept_cones, cones.shape[2])
        all_cones[rows, :, :nearest] = cones[:, :, :nearest]
        all_counts[rows] = np.minimum(count, nearest)
    return all_cones, all_counts
