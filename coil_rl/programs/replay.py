"""`coil-replay`: what guides and trained agents would have steered in a recorded drive."""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Mapping
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from coil_rl.envs import McapReplayEnv
from coil_rl.errors import UserError
from coil_rl.files import write_text
from coil_rl.programs import app
from coil_rl.replay import (
    RECORDED,
    OpenLoop,
    Policies,
    annotate,
    describe,
    draw_steering,
    foxglove_layout,
    open_loop,
    over_time,
)
from coil_rl.replay.names import numbered, of_runs, plain, repeated
from coil_rl.replay.tables import extent, farthest, notes
from coil_rl.report import write_csv
from coil_rl.train import load
from coil_rl.train.build import build, build_guides
from coil_rl.train.check import check_guide_in_env, check_values, make_folder

Runs = Mapping[str, tuple[Path, DictConfig]]


def replay(config: DictConfig) -> None:
    """Ask every policy about every scan, and write what each recording gives; `replay.md` comes last."""
    torch.set_num_threads(config.threads)
    env = replay_env(config)
    runs, policies = find_policies(config, env)
    with tqdm(total=int(env.length.max()) * len(policies), unit="scan", desc="replay", leave=False) as bar:

        def tick(name: str) -> None:
            bar.set_postfix_str(name, refresh=False)
            bar.update()

        everything = open_loop(env, policies, seed=config.seed, tick=tick)
    folder = Path(config.run_dir)
    names = numbered([found.recording.path.name.removesuffix(".mcap") for found in everything])
    places = [folder / name for name in names] if len(names) > 1 else [folder]
    for place, found in zip(tqdm(places, unit="recording", desc="write", leave=False), everything, strict=True):
        write(config, found, runs, place)
    who = [f"{name} is {run} ({config.policy} policy)." for name, (run, _) in runs.items()]
    text = "\n\n".join([*map(describe, everything), *who, notes(env.max_steering).strip()])
    write_text(folder / "replay.md", text)
    print(f"{text}\n")
    for place, found in zip(places, everything, strict=True):
        print(f"{outcome(found)}; see {place}")


def replay_env(config: DictConfig) -> McapReplayEnv:
    """The recordings, read and with their cones perceived.

    Raises:
        UserError: if one cannot be used.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that a file is cut off is said where the results are
        env: McapReplayEnv = build(config.env, "env", McapReplayEnv)
    if twice := repeated([str(recording.path.resolve()) for recording in env.recordings]):
        raise UserError(f"recording names {twice} twice; leave one out")
    return env


def find_policies(config: DictConfig, env: McapReplayEnv) -> tuple[Runs, Policies]:
    """The trained runs by the names of their policies, and all policies with the guides first.

    Raises:
        UserError: if one cannot be had or cannot act on recordings, or two have the same name.
    """
    guides = build_guides(config) if config.guide else {}
    for name, guide in guides.items():
        check_guide_in_env(guide, env, f"guide.{name}")
    folders = [Path(run).expanduser() for run in config.runs]
    if twice := repeated([str(folder.resolve()) for folder in folders]):
        raise UserError(f"runs names {twice} twice; leave one out")
    kept = [load.read_config(folder, "runs", {"device": config.device}) for folder in folders]
    called = [plain(name) for name in guides], of_runs([own.label for own in kept], [own.seed for own in kept])
    if twice := repeated([RECORDED, *called[0], *called[1]]):
        raise UserError(f"two policies would be called {twice}; leave one out, or give the guide another name")
    runs = dict(zip(called[1], zip(folders, kept, strict=True), strict=True))
    agents = {name: load.load_policy_in_env(run, own, env, config.policy) for name, (run, own) in runs.items()}
    return runs, {name: (env, guide) for name, guide in zip(called[0], guides.values(), strict=True)} | agents


def write(config: DictConfig, found: OpenLoop, runs: Runs, folder: Path) -> None:
    """Write what one recording gives: `annotated.mcap`, its Foxglove layout, `steering.csv` and `steering.png`."""
    robot = config.env
    # Where the results are does not make them others.
    kept = OmegaConf.masked_copy(config, [str(key) for key in config if key != "run_dir"])
    attached = {"config.yaml": OmegaConf.to_yaml(kept, resolve=True).encode()}
    about = {"config_sha256": _sum(attached["config.yaml"])}
    for name, (run, _) in runs.items():
        attached[f"{name}/config.yaml"] = (run / "config.yaml").read_bytes()
        about[f"{name}_config_sha256"] = _sum(attached[f"{name}/config.yaml"])
        about[f"{name}_checkpoint_sha256"] = _sum(load.weights_file(run, config.policy).read_bytes())
    annotate(
        found,
        folder / "annotated.mcap",
        copied=[topic for topic in (robot.scan, robot.odometry, robot.command) if topic],
        speed=robot.speed,
        scale=robot.scale,
        laser_yaw=math.radians(OmegaConf.select(robot, "perception.laser_yaw", default=0.0)),
        about=about,
        attached=attached,
    )
    write_text(folder / "foxglove_layout.json", foxglove_layout(found, scan=robot.scan, command=robot.command))
    write_csv(over_time(found), folder / "steering.csv")
    simulated = " (simulated)" if found.recording.simulated else ""
    draw_steering(found, folder / "steering.png", title=f"{found.recording.path.name}{simulated}")


def outcome(found: OpenLoop) -> str:
    """How much was replayed, and who disagree most."""
    said = f"{found.recording.path}: {extent(found)}"
    if far := farthest(found):
        said += f"; {far[1]} and {far[2]} disagree most, by {far[0]:.3f} on average"
    return said


def _sum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def check(config: DictConfig) -> None:
    """Refuse a configuration with which nothing can be replayed.

    Raises:
        UserError: in one sentence, what is wrong.
    """
    check_values(config)
    if config.recording is None:
        raise UserError("recording must be an MCAP file or a rosbag2 directory, or a list of them: recording=FILE")
    if not config.guide and not config.runs:
        raise UserError("there is nobody to ask; give a guide, as in guide=spline, or runs=[FOLDER]")
    make_folder(Path(config.run_dir))


def main() -> None:
    """Entry point."""
    app.run(replay, "replay", check)


if __name__ == "__main__":
    main()
