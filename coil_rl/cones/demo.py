"""`coil-demo`: a picture of a trained agent beside its guide, from a shipped policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coil_rl.errors import UserError
from coil_rl.programs import app

if TYPE_CHECKING:
    from coil_rl.run.evaluation import EvaluationResult

POLICY, TRACK = "cone_track/coil_anchored", "test_1"
PICTURE = "coil_demo.png"
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
    lines = {name: [pose[:, :2] for pose in lap.histories["pose"]] for name, lap in laps.items()}
    crashed = {name: [bool(each["crashed"]) for each in lap.episodes] for name, lap in laps.items()}
    draw_lines([shipped_track(TRACK)], lines, path, crashed=crashed)
    print(
        f"demo: {path} shows where both drove: the guide steers for the middle between the cones "
        "that it sees, the agent observes what the guide would do and decides itself."
    )
    for name, result in laps.items():
        print(f"demo: {name}: {_outcome(result)}")
    print("Next:")
    for command in (
        "coil-train",
        f"coil-evaluate run=pretrained:{POLICY}",
        f"coil-listen run=pretrained:{POLICY}",
        f"coil-export run=pretrained:{POLICY}",
    ):
        print(f"  {command}")


def driven() -> dict[str, EvaluationResult]:
    """Return one lap of the guide, and one of the agent, on the same track, by their titles."""
    from coil_rl.config.python import pretrained
    from coil_rl.guides.simple import FollowAdvice

    run = pretrained(POLICY)
    evaluation = replace(run.trial.evaluation, record={"pose": ("info", "pose")})
    env: Any = run.trial.env(1)  # of the first case, which is `TRACK`
    env.base_env.laps = 1
    policies = {"guide alone": FollowAdvice(env), "agent with its advice": run.policy(env)}
    return {name: evaluation.run(env, policy) for name, policy in policies.items()}


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
        raise UserError(
            f"{' '.join(arguments)} is not the name of one picture, which ends with .png; give "
            f"one, or nothing for {PICTURE}"
        )
    return Path(arguments[0]).expanduser()


main = partial(app.plain_program, "demo", HELP, lambda arguments: demo(target(arguments)))

if __name__ == "__main__":
    main()
