"""`coil-demo`: a picture of a trained agent beside its guide, from a shipped policy."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coil_rl.errors import UserError
from coil_rl.programs import app

if TYPE_CHECKING:
    from coil_rl.run.evaluation import EvaluationResult

POLICY, TRACK = "cone_track/coil_anchored", "test_1"
PICTURE = "coil_demo.png"
USAGE = "coil-demo takes nothing, or the name of the picture: coil-demo FILE.png"
HELP = """coil-demo: a picture of a trained agent beside its guide, from a shipped policy.

  coil-demo
  coil-demo lap.png
  coil-demo ~/pictures/lap.png"""


def demo(path: Path) -> None:
    """Drive one lap with a shipped policy and with its guide, and draw both lines."""
    from coil_rl.cones.lines import draw_lines
    from coil_rl.envs import shipped_track

    print(f"demo: one lap on a track that {POLICY} has never seen ...", flush=True)
    laps = driven()
    agent, guide = laps[:1], laps[1:]
    lines, crashed = {}, {}
    for name, result in (("guide alone", guide), ("agent with its advice", agent)):
        lines[name] = [pose[:, :2] for pose in result.histories["pose"]]
        crashed[name] = [bool(episode["crashed"]) for episode in result.episodes]
    draw_lines([shipped_track(TRACK)], lines, path, crashed=crashed)
    print(
        f"demo: {path} shows where both drove: the guide steers for the middle between the cones "
        "that it sees, the agent observes what the guide would do and decides itself."
    )
    for name, result in (("guide", guide), ("agent", agent)):
        print(f"demo: {name}: {_outcome(result)}")
    print("Next:")
    for command in (
        "coil-train",
        f"coil-evaluate run=pretrained:{POLICY}",
        f"coil-listen run=pretrained:{POLICY}",
        f"coil-export run=pretrained:{POLICY}",
    ):
        print(f"  {command}")


def driven() -> EvaluationResult:
    """Return one lap of the agent, and one of its guide, on the same track."""
    from importlib import resources

    import torch

    from coil_rl.config.assemble import assemble
    from coil_rl.config.folder import folder_of, read_config
    from coil_rl.config.parts import build_evaluation
    from coil_rl.guides.simple import FollowAdvice
    from coil_rl.run.parts import TEST
    from coil_rl.run.policy_batch import Acting, OnRows, traced

    folder = folder_of(POLICY)
    config = read_config(folder, "run")
    torch.set_num_threads(config.threads)
    file = str(resources.files("coil_rl.envs") / "tracks" / "test" / f"{TRACK}.csv")
    tracks = {"_target_": "coil_rl.envs.load_tracks", "path": file}
    config.env.laps = 1
    config.evaluation.env.tracks = tracks
    config.evaluation.cases = [TRACK]
    run = assemble(config, folder)
    env = run.make_env(2, TEST)
    policy = OnRows([Acting(traced(run.policy(env)), whole=True), Acting(FollowAdvice(env))])
    evaluation = build_evaluation(config, {"pose": ("info", "pose")})
    return evaluation.run(env, policy)


def _outcome(result: EvaluationResult) -> str:
    """Return what a lap was like."""
    (episode,) = result.episodes
    measures: dict[str, Any] = dict(episode)
    if measures["crashed"]:
        return f"crashed after {measures['steps']} steps"
    return (
        f"lap time {measures['lap_time']:.1f} s, smoothness {measures['smoothness']:.3f} (lower is "
        f"smoother), reward {measures['reward']:.1f}"
    )


def target(arguments: Sequence[str]) -> Path:
    """Return the path of the picture.

    Raises:
        UserError: for several arguments, or one that does not end with .png.
    """
    if not arguments:
        return Path(PICTURE)
    if len(arguments) > 1 or not arguments[0].endswith(".png"):
        raise UserError(f"{' '.join(arguments)}: {USAGE}")
    return Path(arguments[0]).expanduser()


def main() -> None:
    """Entry point."""
    if sys.argv[1:] in (["--help"], ["-h"]):
        print(HELP)
        return
    with app.program("demo"):
        demo(target(sys.argv[1:]))


if __name__ == "__main__":
    main()
