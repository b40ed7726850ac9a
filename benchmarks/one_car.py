"""Speed of many cars with a guide beside one car in NumPy and SciPy."""

from __future__ import annotations

import sys
from argparse import Namespace
from pathlib import Path

from benchmarks.driving import Driving, driving_env, train_config
from benchmarks.timing import Row, Work, measure, median_ratio, medians
from coil_rl.config.nodes import build

TESTS = Path(__file__).parents[1] / "tests"
ORACLE_STEPS = 20


def measure_one_car(args: Namespace) -> list[Row]:
    """Return the speed of cars driven by the guide beside one car in NumPy and SciPy."""
    ours = Driving(driving_env(args, args.compare_cars, guide=True), follow=True)
    rates = measure(args, {"one car": one_car(args), "ours": ours})
    row = {f"{name} (steps/s)": rate for name, rate in medians(rates).items()}
    ratio = median_ratio(rates["ours"], rates["one car"])
    return [{"cars": args.compare_cars, **row, "ratio": ratio, "rounds": rates}]


def one_car(args: Namespace) -> Work:
    """Return steps of `tests/oracle.py` on the training tracks in turn, driven by the guide."""
    sys.path.append(str(TESTS))
    import oracle  # type: ignore[import-not-found,import-untyped,unused-ignore]

    config = train_config(args, "coil")
    keys = ("rate", "spline", "smoothing", "cone_bonus", "held_steps", "laps")
    options = {key: config.env[key] for key in keys}
    node = config.guide.get("spline", {})
    guide = {key: node[key] for key in ("spline", "smoothing", "gain") if key in node}
    cars = []
    for track in build(config.track.train, "track.train"):
        cars.append(oracle.OneCar(track.left, track.right, track.start, **options))

    def steps() -> int:
        for _ in range(ORACLE_STEPS):
            car = cars[0]
            result = car.step(oracle.guide_action(*car.cones(), car.steering, **guide))
            if result.terminated or result.truncated:
                cars.append(cars.pop(0))
                cars[0].reset()
        return ORACLE_STEPS

    return steps
