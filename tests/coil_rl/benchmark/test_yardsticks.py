from types import SimpleNamespace

import oracle
from hydra import compose, initialize_config_module

from coil_rl.benchmark import yardsticks
from coil_rl.benchmark.turns import Turns


def benchmark_config(*overrides):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose("benchmark", ["run_dir=nowhere", "track=generated", "track.train.count=1", *overrides])


def test_one_car_drives_a_lap_and_starts_anew(monkeypatch):
    outcomes = []
    step = oracle.OneCar.step

    def remember(car, action):
        outcomes.append(step(car, action))
        return outcomes[-1]

    monkeypatch.setattr(oracle.OneCar, "step", remember)
    drive = yardsticks.one_car(oracle, benchmark_config("env.laps=1", "env.rate=8"))
    while not any(outcome.terminated for outcome in outcomes):
        assert drive() == yardsticks.ORACLE_STEPS
    assert not any(outcome.crashed for outcome in outcomes)
    drive()
    assert not outcomes[-1].terminated


def test_what_is_not_there_is_said_and_not_measured(monkeypatch, tmp_path):
    config, turns = benchmark_config(), Turns(0.0, 1, "cpu")
    monkeypatch.setattr(yardsticks, "ORACLE", tmp_path / "oracle.py")
    assert "no checkout" in yardsticks.measure_oracle(config, turns)["not_measured"]
    missing = SimpleNamespace(util=SimpleNamespace(find_spec=lambda name: None))
    monkeypatch.setattr(yardsticks, "importlib", missing)
    assert "coil-rl[bench]" in yardsticks.measure_sb3(config, turns)["not_measured"]
