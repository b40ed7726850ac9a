"""Whether a perception fits a recording, and a robot its recorded commands."""

from coil_rl.envs.recordings import caution_about_view
from coil_robot.replay.open_loop import OpenLoop

BEYOND = 0.1  # share of the commands


def caution(result: OpenLoop, perception: object) -> str:
    """Return a warning if the perception or the commands hardly fit the recording, else nothing.

    Args:
        perception: of the env; only a `Perception` is asked for the clusters.
    """
    view = result.cones, result.count, result.both_valid
    text = caution_about_view(result.recording, *view, perception)
    about_commands = _caution_about_commands(result)
    return "; ".join(part for part in (text, about_commands) if part)


def _caution_about_commands(result: OpenLoop) -> str:
    """Return a warning if the recorded commands ask for more than the robot can steer."""
    beyond = result.beyond
    if beyond <= BEYOND:
        return ""
    recording = result.recording
    unit = "steering angles" if recording.steered else "turn rates"
    needed = "radians" if recording.steered else "radians a second, for env.car_length"
    return (
        f"{recording.path}: {beyond:.0%} of the recorded {unit} are beyond what the robot can "
        f"steer, and count as its limit; check that they are in {needed}"
    )
