import importlib.util
import json

import pytest
from PIL import Image
from programs import TRACK, called, program

PARTS = ["start", "memory", "env", "training", "shares", "robot", "oracle", "sb3", "profile"]


@pytest.mark.slow
def test_quick_benchmark_measures_everything(tmp_path):
    arguments = ["quick=true", "track=generated", "track.train.count=1", "hydra.run.dir=run"]
    done = program("benchmark", *arguments, cwd=tmp_path)
    found = json.loads((tmp_path / "run" / "benchmark.json").read_text())
    assert set(found) == {"versions", "settings", "goals", *PARTS}
    assert found["settings"]["repeats"] == 2

    for row in found["env"]:
        assert row["ms_per_batched_step"] * row["steps_per_s"] == pytest.approx(1e3 * row["cars"])
        assert all(len(rounds) == 2 and min(rounds) > 0 for rounds in row["rounds"].values())
    assert [row["cars"] for row in found["env"]] == [16, 64]
    for row in found["training"]:
        assert row["ppo_over_plain"] > 0
        assert row["coil_frame_cost_over_ppo"] > 0
    for row in found["shares"]:
        shares = [row[key] for key in ("env", "guide", "policy", "update", "framework")]
        assert sum(shares) == pytest.approx(1)
        assert all(share > 0 or (key, row["method"]) == (1, "ppo") for key, share in enumerate(shares))
    assert found["start"]["total_s"] > found["start"]["import_s"] > 0
    assert 172 < found["memory"]["state_bytes_per_car"] < 2000
    assert [row["scans_per_s"] > 0 for row in found["robot"]] == [True] * 3
    assert found["oracle"]["ratio"] > 0
    assert found["profile"]["operators"][0]["ms_per_step"] > 0
    if importlib.util.find_spec("stable_baselines3"):
        assert [row["envs"] for row in found["sb3"]["stable_baselines3"]] == [1, 8]
        assert all(row["ratio"] > 0 for row in found["sb3"]["stable_baselines3"])
    else:
        assert "not installed" in found["sb3"]["not_measured"]

    assert done.stdout.startswith("## Goals")
    assert (tmp_path / "run" / "benchmark.md").read_text().strip() in done.stdout
    assert done.stdout.splitlines()[-1].endswith("goals met; see " + str(tmp_path / "run"))
    assert "Traceback" not in done.stderr
    with Image.open(tmp_path / "run" / "benchmark.png") as image:
        assert image.width >= 600
    again = program("benchmark", "parts=[start]", "hydra.run.dir=run", cwd=tmp_path, code=2)
    assert "already holds a benchmark" in again.stderr


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("PPO", ["learner.epochs=1", "learner.minibatches=2"]),
        ("A2C", ["learner=a2c"]),
        ("DQN", ["learner=dqn", "learner.starts=300", "learner.ratio=1"]),
    ],
)
def test_learners_are_measured_with_the_guide_and_without_and_ppo_beside_its_yardsticks(name, arguments, tmp_path):
    parts = "parts=[training]" if name == "PPO" else "parts=[training,sb3]"
    done = called("benchmark", *TRACK, "quick=true", parts, *arguments, "hydra.run.dir=run", cwd=tmp_path)
    found = json.loads((tmp_path / "run" / "benchmark.json").read_text())
    (row,) = found["training"]
    assert row["learner"] == name
    assert f"| {name} " in done.stdout
    plain = {"plain_ppo", "plain_coil"} if name == "PPO" else set()
    assert set(row["rounds"]) == {"ppo", "coil"} | plain
    assert all(row[f"{subject}_frames_per_s"] > 0 for subject in row["rounds"])
    assert len(found["goals"]) == len(plain)
    assert ("sb3: not measured: Stable-Baselines3 runs PPO" in done.stdout) == (name != "PPO")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["parts=[envy]"], "parts: there is no envy; there are start, memory, env, training"),
        (["device=cuda:77"], "device=cuda:77 cannot be used"),
        (["repeat=3"], "there is no key repeat"),
        ([*TRACK, "learner=forest"], "Imitation does not learn from reward alone"),
    ],
)
def test_mistakes_are_one_sentence_and_exit_code_2(arguments, words, tmp_path):
    done = called("benchmark", *arguments, cwd=tmp_path, code=2)
    (sentence,) = done.stderr.strip().splitlines()
    assert words in sentence
