"""`coil-replay`: the steering of guides and trained agents at every scan of recorded drives."""

from __future__ import annotations

import hashlib
import math
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

import coil_robot.schema  # noqa: F401  registers the root configurations with Hydra
from coil_rl import UserError, run_program

if TYPE_CHECKING:
    from coil_rl import Run
    from coil_rl.envs import McapReplayEnv
    from coil_robot.replay.open_loop import OpenLoop, Policies

# Keys that have an effect without runs, too.
USED = ("recording", "frame", "strict", "preset", "env", "guide", "runs")
Runs = Mapping[str, "Run"]  # by name of the policy


def replay(config: DictConfig) -> None:
    """Run all policies through all recordings.

    The results of each recording are written, then `replay.md`.
    """
    from coil_rl import build, write_text
    from coil_rl.envs import McapReplayEnv
    from coil_rl.for_guests import progress
    from coil_robot.replay.open_loop import open_loop
    from coil_robot.replay.report import NOTES, describe, outcome

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the report has the remarks on the recordings
        env = build(config.env, "env", McapReplayEnv)
    _check_unique("recording", [recording.path for recording in env.recordings])
    runs, policies = _load_policies(config, env)
    results = open_loop(env, policies, seed=config.seed)
    folder = Path(config.run_dir)
    names = _numbered([result.recording.path.name.removesuffix(".mcap") for result in results])
    folders = [folder / name for name in names] if len(names) > 1 else [folder]
    destinations = progress(iterable=folders, unit="recording", desc="write", leave=False)
    for destination, result in zip(destinations, results, strict=True):
        _write(config, result, runs, destination)
    parts = [describe(result) for result in results]
    doubts = [text for number in range(len(results)) for text in env.cautions(number)]
    parts += [f"Warning: {each}." for each in doubts]
    parts += [f"{name} is {run.folder} (policy {config.policy})." for name, run in runs.items()]
    parts.append(NOTES.format(max_steering=math.degrees(env.max_steering)))
    text = "\n\n".join(parts)
    write_text(folder / "replay.md", text)
    print(f"{text}\n")
    for destination, result in zip(folders, results, strict=True):
        print(f"{outcome(result)}; see {destination}")
    for text in doubts:
        print(f"replay: {text}", file=sys.stderr)


def _load_policies(config: DictConfig, env: McapReplayEnv) -> tuple[Runs, Policies]:
    """Return the runs and all policies by name, guides first."""
    from coil_rl import open_run
    from coil_rl.for_guests import build_guides, check_guide_in_env
    from coil_robot.replay.open_loop import RECORDED

    guides = build_guides(config) if config.guide else {}
    for name, guide in guides.items():
        check_guide_in_env(guide, env, f"guide.{name}")
    opened = [open_run(run, device=config.device) for run in config.runs]
    _check_unique("runs", [run.folder for run in opened])
    guide_names = [_topic_name(name) for name in guides]
    run_names = _run_names([run.label for run in opened], [run.seed for run in opened])
    repeated = _first_repeated([RECORDED, *guide_names, *run_names])
    if repeated is not None:
        raise UserError(
            f"two policies would be called {repeated}; "
            "leave one out, or give the guide another name"
        )
    runs = dict(zip(run_names, opened, strict=True))
    policies = {}
    for name, guide in zip(guide_names, guides.values(), strict=True):
        policies[name] = (env, guide)
    for name, run in runs.items():
        policies[name] = run.in_env(env, config.policy)
    return runs, policies


def _write(config: DictConfig, result: OpenLoop, runs: Runs, folder: Path) -> None:
    """Write the results of one recording.

    These are `annotated.mcap`, its Foxglove layout, `steering.csv` and `steering.png`.
    """
    from coil_rl import write_text
    from coil_rl.report import write_csv
    from coil_robot.replay.annotation import annotate, foxglove_layout
    from coil_robot.replay.report import draw_steering, over_time

    robot = config.env
    # The folder of the results is left out, so that it does not change the bytes.
    settings = OmegaConf.masked_copy(config, [str(key) for key in config if key != "run_dir"])
    attachments = {"config.yaml": OmegaConf.to_yaml(settings, resolve=True).encode()}
    inputs = {"config": attachments["config.yaml"]}
    for name, run in runs.items():
        text = (run.folder / "config.yaml").read_bytes()
        attachments[f"{name}/config.yaml"] = inputs[f"{name}_config"] = text
        inputs[f"{name}_checkpoint"] = run.weights(config.policy).read_bytes()
    about = {}
    for name, content in inputs.items():
        about[f"{name}_sha256"] = hashlib.sha256(content).hexdigest()
    topics = (robot.scan, robot.odometry, robot.command, result.recording.command_topic)
    annotate(
        result,
        folder / "annotated.mcap",
        topics=dict.fromkeys(topic for topic in topics if topic),
        about=about,
        attachments=attachments,
    )
    layout = foxglove_layout(result, scan=robot.scan)
    write_text(folder / "foxglove_layout.json", layout)
    write_csv(over_time(result), folder / "steering.csv")
    simulated = " (simulated)" if result.recording.simulated else ""
    draw_steering(result, folder / "steering.png", title=f"{result.recording.path.name}{simulated}")


def _topic_name(name: str) -> str:
    """Return a name as ROS topics require it.

    It has letters, digits and single underscores only, and begins with a letter.
    """
    plain = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
    return plain if plain[:1].isalpha() else f"policy_{plain}".rstrip("_")


def _run_names(labels: Sequence[str], seeds: Sequence[int]) -> list[str]:
    """Return a name for each run: its label, and the seed and a number where names are equal."""
    names = [_topic_name(label) for label in labels]
    seeded = []
    for name, seed in zip(names, seeds, strict=True):
        seeded.append(f"{name}_seed{seed}" if names.count(name) > 1 else name)
    return _numbered(seeded)


def _numbered(names: Sequence[str]) -> list[str]:
    """Return the names, with a number appended to equal ones."""
    numbered = []
    for n, name in enumerate(names, start=1):
        numbered.append(f"{name}_{names[:n].count(name)}" if names.count(name) > 1 else name)
    return numbered


def _first_repeated(names: Sequence[str]) -> str | None:
    """Return the first name that was there before; None if all are different."""
    return next((name for n, name in enumerate(names) if name in names[:n]), None)


def _check_unique(key: str, paths: Sequence[Path]) -> None:
    """Raise a `UserError` if two of the paths that a key names are the same."""
    repeated = _first_repeated([str(path.resolve()) for path in paths])
    if repeated is not None:
        raise UserError(f"{key} names {repeated} twice; leave one out")


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration."""
    from coil_rl.for_guests import check_unused, check_used

    if config.recording is None:
        raise UserError(
            "recording must be an MCAP file or a rosbag2 folder, or a list of them: recording=FILE"
        )
    if not config.guide and not config.runs:
        raise UserError("there is no policy; give a guide, as in guide=spline, or runs=[FOLDER]")
    if config.runs:
        check_used((*USED, "policy"), "nothing in a replay reads it")
    else:
        check_used(USED, "nothing in a replay without runs reads it")
    check_unused(("env.num_envs",), "each recording has a row of its own")
    check_unused(("env.smooth",), "a replay earns no reward")


main = partial(run_program, replay, "replay", check, "pkg://coil_robot.conf")

if __name__ == "__main__":
    main()
