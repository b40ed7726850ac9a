"""Report of an open-loop evaluation.

It has a Markdown table, a CSV file with a row per scan, and a figure of the steering over time.
"""

import os
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.patches import Patch

from coil_rl.report import markdown_table, style
from coil_robot.replay.open_loop import RECORDED, OpenLoop

# Under the tables; with the largest steering in degrees.
NOTES = (
    "Actions are fractions of {max_steering:.0f} degrees. smoothness: mean |a - mean of the last "
    "20 actions|.\nomega: mean |omega|. from X: mean |a - x|. No policy controlled the drive: each "
    "action is the policy's choice\nat a scan of a drive that went another way. recorded: the "
    "steering that the last command before the next scan\nmeans at its speed."
)


def describe(result: OpenLoop) -> str:
    """Return a section of Markdown about one recording."""
    columns = {
        "policy": ("policy", ""),
        "smoothness": ("smoothness", ".3f"),
        "omega": ("omega (rad/s)", ".3f"),
    }
    steering = result.steering.items()
    frame = pd.DataFrame(
        {
            "smoothness": {name: pd.Series(each.smoothness).mean() for name, each in steering},
            "omega": {name: pd.Series(each.omega).abs().mean() for name, each in steering},
        }
    )
    if len(frame) > 1:
        distances = disagreement(result)
        frame = frame.join(distances.mask(np.eye(len(distances), dtype=bool)).add_prefix("from "))
        columns |= {f"from {name}": (f"from {name}", ".3f") for name in result.steering}
    rows = frame.rename_axis("policy").reset_index().to_dict("records")
    simulated = " (simulated)" if result.recording.simulated else ""
    heading = f"## {result.recording.path}{simulated}"
    return f"{heading}\n\n{extent(result)}.\n\n{markdown_table(rows, columns)}"


def extent(result: OpenLoop) -> str:
    """Return what a recording holds.

    These are the number of scans and of commands, the duration, the rate, the share of scans with
    both boundaries valid, and remarks on the file.
    """
    recording = result.recording
    rate = f", {1 / recording.turn:.1f} a second" if recording.turn else ""
    text = (
        f"{len(result.both_valid)} scans in {recording.seconds[-1]:.1f} s{rate}; "
        f"both boundaries valid in {result.both_valid.mean():.0%} of them"
    )
    if recording.commands is not None:
        text += f"; {len(recording.commands[0])} commands"
    return "; the file ".join([text, *recording.remarks])


def disagreement(result: OpenLoop) -> pd.DataFrame:
    """Return the mean |a - b| of each pair of policies, over the scans with both actions."""
    actions = pd.DataFrame({name: steering.action for name, steering in result.steering.items()})
    return pd.DataFrame({name: actions.sub(actions[name], axis=0).abs().mean() for name in actions})


def outcome(result: OpenLoop) -> str:
    """Return the extent of the recording, and which policies disagree most."""
    text = f"{result.recording.path}: {extent(result)}"
    distances = disagreement(result)
    pairs = distances.where(np.triu(np.ones(distances.shape, dtype=bool), 1)).stack().dropna()
    if pairs.empty:
        return text
    first, second = pairs.idxmax()
    return f"{text}; {first} and {second} disagree most, by {pairs.max():.3f} on average"


def over_time(result: OpenLoop) -> list[dict[str, Any]]:
    """Return a row per scan.

    Its columns are the time (s), whether both boundaries are valid, and the actions and omegas
    (radians/s) of all policies.
    """
    columns: dict[str, Any] = {
        "time": result.recording.seconds,
        "valid": result.both_valid.astype(int),
    }
    for policy, steering in result.steering.items():
        columns |= {f"{policy}/steering": steering.action, f"{policy}/omega": steering.omega}
    return pd.DataFrame(columns).to_dict("records")


def draw_steering(
    result: OpenLoop, path: str | os.PathLike[str], *, title: str | None = None
) -> None:
    """Draw steering and omega of each policy over time.

    Recorded commands are dashed. Scans without both boundaries are grey.

    Args:
        title: above the picture.
    """
    seconds, invalid = result.recording.seconds, ~result.both_valid
    strokes = style.strong_strokes(result.policies)
    if RECORDED in result.steering:
        strokes[RECORDED] = style.Stroke(style.GUIDES[0], style.DASHED)
    handles = style.handles(strokes, lw=1.6)
    if invalid.any():
        handles.append(Patch(color=style.ASPHALT, lw=0, label="a boundary from the memory"))
    with style.picture(path, title, handles, 5.0, h_pad=0.08) as figure:
        steering_axes, omega_axes = figure.subplots(2, sharex=True)
        for axes, label in (
            (steering_axes, "steering (degrees)"),
            (omega_axes, "omega (radians/s)"),
        ):
            axes.set_ylabel(label)
            axes.spines[["top", "right"]].set_visible(False)
            axes.axhline(0, color=style.KERB, lw=0.7)
            axes.margins(x=0.01)
            axes.fill_between(
                seconds,
                0,
                1,
                where=invalid,
                step="mid",
                transform=axes.get_xaxis_transform(),
                color=style.ASPHALT,
                lw=0,
            )
            axes.set_axisbelow(True)
        for name, stroke in strokes.items():
            line: dict[str, Any] = {"color": stroke.colour, "ls": stroke.linestyle, "lw": 1.1}
            degrees = np.degrees(result.steering[name].action * result.env.max_steering)
            steering_axes.plot(seconds, degrees, **line)
            omega_axes.plot(seconds, result.steering[name].omega, **line)
        omega_axes.set_xlabel("time (s)")
