"""What recordings demonstrate: how many scans have steering to learn, and why others have none."""

from collections.abc import Iterator, Sequence
from typing import Any

from coil_rl.envs.recordings.recording import Recording


def about_demonstrations(env: Any) -> Iterator[str]:
    """Yield a line about each recording, and one about all together.

    It says how many scans are learned, how many are left out and why, and what makes the meaning of
    the recording doubtful.

    Args:
        env: a `McapReplayEnv`.

    Raises:
        ValueError: if no scan has steering to learn.
    """
    kept, total = 0, 0
    _check_different(env.recordings)
    for row, recording in enumerate(env.recordings):
        scans = env.scans_of(row)
        stale, standing = env.stale[scans], env.standing[scans]
        number, usable = len(stale), int((~stale & ~standing).sum())
        kept, total = kept + usable, total + number
        line = (
            f"{recording.path}: {usable} of {number} scans are learned; left out: "
            f"{int(stale.sum())} without a command of the last {recording.command_age:.2f} s, "
            f"{int((standing & ~stale).sum())} of a robot that stands"
        )
        yield "; the file ".join([line, *recording.remarks])
        yield from (f"Warning: {text}." for text in env.cautions(row))
    yield f"{len(env.recordings)} recordings: {kept} of {total} scans are learned."
    if not kept:
        raise ValueError(
            "no scan has recorded steering to learn: there is no recent command at any, or the "
            "robot stands; give env.command=TOPIC, or other recordings"
        )


def _check_different(recordings: Sequence[Recording]) -> None:
    """Raise a `ValueError` for a recording that is there twice, which would test itself."""
    known: dict[bytes, Recording] = {}
    for recording in recordings:
        other = known.setdefault(recording.ranges.tobytes(), recording)
        if other is not recording:
            raise ValueError(
                f"{other.path} and {recording.path} hold the same scans; leave one of them out"
            )
