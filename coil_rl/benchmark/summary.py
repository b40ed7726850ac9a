"""From measurements to Markdown: one small table a question, and the goals with whether they were met."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from coil_rl.report import markdown_table

Columns = Mapping[str, tuple[str, str]]

DRIVING: Columns = {
    "cars": ("cars", ""),
    "steps_per_s": ("steps/s", ",.0f"),
    "steps_per_s_with_guide": ("with the guide's advice", ",.0f"),
    "steps_per_s_guide_drives": ("the guide drives", ",.0f"),
    "ms_per_batched_step": ("ms a batched step", ".2f"),
    "ms_per_batched_step_with_guide": ("with the advice (ms)", ".2f"),
    "resets_per_1000_steps": ("resets in 1000 steps", ".1f"),
}
COMPILED: Columns = {
    "cars": ("cars", ""),
    "steps_per_s_with_guide": ("steps/s with the guide", ",.0f"),
    "steps_per_s_with_guide_compiled": ("compiled", ",.0f"),
    "compile_s": ("compiling (s)", ".0f"),
}
TRAINING: Columns = {
    "learner": ("learner", ""),
    "cars": ("cars", ""),
    "steps": ("steps", ""),
    "ppo_frames_per_s": ("no guide (frames/s)", ",.0f"),
    "coil_frames_per_s": ("COIL", ",.0f"),
    "plain_ppo_frames_per_s": ("no guide, by hand", ",.0f"),
    "plain_coil_frames_per_s": ("COIL by hand", ",.0f"),
    "coil_frame_cost_over_ppo": ("COIL / no guide, cost of a frame", ".2f"),
}
SHARES: Columns = {
    "method": ("method", ""),
    "cars": ("cars", ""),
    "steps": ("steps", ""),
    "env": ("env", ".0%"),
    "guide": ("guide", ".0%"),
    "policy": ("policy", ".0%"),
    "update": ("update", ".0%"),
    "framework": ("framework", ".0%"),
}
OPERATORS: Columns = {
    "operator": ("operator", ""),
    "calls_per_step": ("calls a step", ".1f"),
    "ms_per_step": ("ms a step", ".3f"),
    "share": ("share", ".0%"),
}
ROBOT: Columns = {"what": ("scans of 360 points", ""), "scans_per_s": ("scans/s of a core", ",.0f")}
NUMBERS: Columns = {"what": ("what", ""), "value": ("value", ",.2f")}
GOALS: Columns = {"what": ("ratio or size", ""), "value": ("value", ",.2f"), "goal": ("goal", ""), "met": ("met", "")}

# From a part's key in the results to its heading and columns, in the order of the page.
TABLES: Mapping[str, tuple[str, Columns]] = {
    "env": ("Driving: env steps per second, resets included, at random but where the guide drives", DRIVING),
    "compiled": ("Driving under torch.compile", COMPILED),
    "training": ("Training; PPO also by hand", TRAINING),
    "shares": ("Where the time of an update goes, collecting included", SHARES),
    "robot": ("The robot's recordings and its perception", ROBOT),
}

SPEED_OVER_ONE_CAR = 500.0
SPEED_OVER_PLAIN = 0.9
SPEED_OVER_SB3 = 10.0
STATE_BYTES = 2000.0
SCANS_PER_S = 1000.0


def summarise(results: Mapping[str, Any]) -> str:
    """The page: goals first, then a table for each part that was measured and a line for each that was not."""
    parts = []
    if results["goals"]:
        parts.append(("Goals", markdown_table(results["goals"], GOALS)))
    parts += [
        (heading, markdown_table(rows, {key: column for key, column in columns.items() if key in rows[0]}))
        for part, (heading, columns) in TABLES.items()
        if (rows := results.get(part))
    ]
    numbers = _numbers(results)
    if numbers:
        parts.append(("Start-up, memory and other people's programs", markdown_table(numbers, NUMBERS)))
    if "profile" in results:
        found = results["profile"]
        heading = f"Operators with most time of their own, {found['cars']} cars with the guide"
        total = f"{found['operator_calls_per_step']:,.0f} operator calls a batched step."
        parts.append((heading, markdown_table(found["operators"], OPERATORS) + "\n\n" + total))
    missing = [f"{name}: not measured: {reason}" for name, reason in not_measured(results).items()]
    pages = [f"## {heading}\n\n{text}" for heading, text in parts]
    return "\n\n".join([*pages, *missing])


def goals(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What is promised, what was measured, and whether it holds."""
    rows: list[dict[str, Any]] = []

    def at_least(what: str, value: float, goal: float) -> None:
        rows.append({"what": what, "value": value, "goal": f">= {goal:g}", "met": value >= goal})

    for row in results.get("training", []):
        for name in ("ppo", "coil"):
            if f"{name}_over_plain" in row:  # only PPO is written by hand
                what = f"{name.upper()} training / the same by hand, {row['cars']} x {row['steps']}"
                at_least(what, row[f"{name}_over_plain"], SPEED_OVER_PLAIN)
    oracle, sb3 = results.get("oracle", {}), results.get("sb3", {})
    if "ratio" in oracle:
        what = f"driving with the guide, {oracle['cars']} cars / one car in NumPy and SciPy"
        at_least(what, oracle["ratio"], SPEED_OVER_ONE_CAR)
    for row in sb3.get("stable_baselines3", []):
        what = f"PPO training, {sb3['cars']} x {sb3['steps']} / Stable-Baselines3 with {_envs(row['envs'])}"
        at_least(what, row["ratio"], SPEED_OVER_SB3)
    for row in results.get("robot", []):
        if row["what"].startswith("perception"):
            at_least(f"{row['what']} (scans/s of a core)", row["scans_per_s"], SCANS_PER_S)
    if "memory" in results:
        value = results["memory"]["state_bytes_per_car"]
        rows.append({"what": "bytes of state a car", "value": value, "goal": f"< {STATE_BYTES:g}",
                     "met": value < STATE_BYTES})  # fmt: skip
    return rows


def not_measured(results: Mapping[str, Any]) -> dict[str, str]:
    """The parts that could not be measured, and why."""
    return {
        name: found["not_measured"]
        for name, found in results.items()
        if isinstance(found, Mapping) and "not_measured" in found
    }


def _numbers(results: Mapping[str, Any]) -> Sequence[dict[str, Any]]:
    rows: list[tuple[str, float | None]] = []
    if "start" in results:
        start = results["start"]
        rows += [
            ("import (s)", start["import_s"]),
            (f"building an env of {start['cars']} cars with the guide (s)", start["build_s"]),
            ("its reset and first step (s)", start["first_step_s"]),
        ]
    if "memory" in results:
        memory = results["memory"]
        batch = f"{memory['training_cars']} x {memory['training_steps']}"
        rows.append(("growth of the peak a car (kB)", _scaled(memory.get("peak_bytes_per_car"), 1e3)))
        rows.append(("peak while an env is built (MB)", _scaled(memory["building_peak_bytes"], 1e6)))
        rows.append((f"peak of a COIL training, {batch} (MB)", _scaled(memory["training_peak_bytes"], 1e6)))
        if memory["training_peak_device_bytes"] is not None:
            rows.append(("the same on the device (MB)", memory["training_peak_device_bytes"] / 1e6))
    if "oracle_steps_per_s" in results.get("oracle", {}):
        rows.append(("one car in NumPy and SciPy, with the guide (steps/s)", results["oracle"]["oracle_steps_per_s"]))
    for row in results.get("sb3", {}).get("stable_baselines3", []):
        rows.append((f"PPO of Stable-Baselines3 with {_envs(row['envs'])} (frames/s)", row["frames_per_s"]))
    return [{"what": what, "value": value} for what, value in rows]


def _envs(count: int) -> str:
    return "one env" if count == 1 else f"{count} envs"


def _scaled(value: float | None, unit: float) -> float | None:
    return None if value is None else value / unit
