"""What recordings demonstrate: how many scans have steering to learn, and why others have none."""

from collections.abc import Iterator
from typing import Any

from coil_rl.envs.recordings.views import caution_about_view


def about_demonstrations(env: Any) -> Iterator[str]:
    """Yield a line about each recording, and one about all together.

    It says how many scans are learned, how many are left out and why, and what makes the meaning of
    the recording doubtful.

    Args:
        env: a `McapReplayEnv`.

    Raises:
        ValueError: if no scan has steering to learn.
    """
    first, kept, total = 0, 0, 0
    for recording in env.recordings:
        scans = slice(first, first + len(recording.ranges))
        first = scans.stop
        stale, standing = env.stale[scans], env.standing[scans]
        number, usable = len(stale), int((~stale & ~standing).sum())
        kept, total = kept + usable, total + number
        line = (
            f"{recording.path}: {usable} of {number} scans are learned; left out: "
            f"{int(stale.sum())} without a command of the last {recording.command_age:.2f} s, "
            f"{int((standing & ~stale).sum())} of a robot that stands"
        )
        yield "; the file ".join([line, *recording.remarks])
        caution = caution_about_view(
            recording,
            env.cones[scans].cpu().numpy(),
            env.count[scans].cpu().numpy(),
            env.valid[:, scans].all(0).cpu().numpy(),
            env.perception,
        )
        if caution:
            yield f"Warning: {caution}."
    yield f"{len(env.recordings)} recordings: {kept} of {total} scans are learned."
    if not kept:
        raise ValueError(
            "no scan has recorded steering to learn: there is no recent command at any, or the "
            "robot stands; give env.command=TOPIC, or other recordings"
        )
