"""Training on recordings: what a replay of them can teach, and how many steps it has.

A recording does not react to actions, so nothing can be learned there by trial. The steering that
was recorded can be imitated, and the imitation is tested in another env, a closed loop.
"""

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from coil_rl.envs import McapReplayEnv, RecordingError
from coil_rl.envs.recordings.demonstrations import about_demonstrations
from coil_rl.envs.recordings.mcap_files import read_messages
from coil_rl.errors import UserError
from coil_rl.output import say
from coil_rl.run.parts import TRAIN, EnvMaker

ONLY_IMITATION = (
    "a recording does not react to actions, so method={method} cannot learn in env=mcap_replay; "
    "imitate the recorded steering with method=oil, and go on from there in a closed loop: "
    "method=dagger env=simulated_robot learner.dataset=FOLDER/dataset.pt"
)


def replays(config: DictConfig) -> bool:
    """Return whether a configuration trains on recordings."""
    return str(config.env.get("_target_", "")) == "coil_rl.envs.McapReplayEnv"


def check_replay(config: DictConfig, make_env: EnvMaker) -> None:
    """Check a training on recordings, and print what there is to learn from.

    Args:
        config: of a training.
        make_env: makes its env.

    Raises:
        UserError: for a method that needs the effect of its actions, without a recording, and for
            a budget that does not reach all scans.
    """
    if not replays(config):
        return
    if config.env.recordings is None:
        raise UserError(
            "recording must be an MCAP file or a rosbag2 folder, or a list of them: "
            "recording=[FILE,...]"
        )
    explores = False
    for node in config.method.transforms.values():
        probability = OmegaConf.select(node, "probability")
        explores = explores or (probability is not None and probability != 1.0)
    if config.method.learner != "imitation" or explores:
        raise UserError(ONLY_IMITATION.format(method=config.method.name))
    env: Any = make_env.bare(None, TRAIN, None)
    _check_pass(config, env)
    for line in about_demonstrations(env):
        say(line)
    if not (~env.stale & ~env.standing).any():
        raise UserError(
            "no scan has recorded steering to learn: there is no recent command at any, or the "
            "robot stands; give env.command=TOPIC, or other recordings"
        )


def _check_pass(config: DictConfig, env: McapReplayEnv) -> None:
    """Raise a `UserError` for a training that ends before all scans of all recordings were seen."""
    rows, recordings, longest = env.batch_size[0], len(env.recordings), int(env.length.max())
    if rows < recordings:
        raise UserError(
            f"env.num_envs={rows} leaves out recordings, of which there are {recordings}; leave "
            f"budget.num_envs and env.num_envs out, or give at least {recordings}"
        )
    steps = config.budget.steps
    seen = math.ceil(config.budget.frames / (rows * steps)) * steps
    if seen < longest:
        raise UserError(
            f"budget.frames={config.budget.frames} is {seen} steps of each recording, and the "
            f"longest has {longest} scans, so the others would be left out; leave budget.frames "
            f"out, or give at least {rows * longest}"
        )


def check_recordings_to_leave_out(config: DictConfig) -> bool:
    """Return whether a validation leaves out recordings, not tracks.

    Raises:
        UserError: if there is only one.
    """
    if not replays(config):
        return False
    if _recordings(config.env.recordings) == 1:
        raise UserError(
            "there is one recording, which cannot be left out to validate; give several, or set "
            "learner.group_key=null"
        )
    return True


def of_replay(config: DictConfig, what: str) -> int:
    """Return what a training on all scans of all recordings takes.

    Args:
        config: with the env of the recordings.
        what: "num_envs", one for each recording; "steps", the scans of the longest; or "frames".
    """
    recordings = config.env.recordings
    rows = _recordings(recordings)
    if what == "num_envs":
        return rows
    paths = [recordings] if isinstance(recordings, (str, Path)) else list(recordings or ())
    scans = max([_scans(str(path), str(config.env.scan)) for path in paths], default=1)
    return scans if what == "steps" else rows * scans


def _recordings(recordings: Any) -> int:
    """Return the number of recordings in a value of the configuration, at least 1."""
    return 1 if recordings is None or isinstance(recordings, str) else max(1, len(recordings))


@lru_cache(maxsize=256)
def _scans(path: str, topic: str) -> int:
    """Return the number of messages on the topic of the scans, at least 1.

    A recording that cannot be read has 1: what is wrong is said when its env is built.
    """
    try:
        return max(1, len(read_messages(path, [topic]).messages[topic]))
    except RecordingError:
        return 1
