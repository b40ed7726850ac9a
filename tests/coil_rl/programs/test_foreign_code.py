"""A fault in an env or controller of somebody else ends every program with one sentence."""

import warnings

import pytest
from programs import called, read_csv

TINY = [
    *("env=gym", "budget.num_envs=2", "budget.steps=16", "budget.frames=64", "logger=none"),
    *("evaluation.cases=2", "evaluation.curve.num_envs=2", "evaluation.curve.points=1"),
    *("learner=ppo", "learner.minibatches=2", "hydra.run.dir=run"),
]
ALONE = ["env=gym", "env.id=odd_parts:Lasting", "evaluation.cases=2", "hydra.run.dir=run"]
LATE = ["guide=controller", "guide.controller.of=odd_parts:Late"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "words", "message"),
    [
        ("train", [*TINY, "env.id=odd_parts:Raises"], "step raised AssertionError: the pump is"),
        ("evaluate", [*ALONE, *LATE], "the controller odd_parts:Late (row 0, step 10)"),
    ],
)
def test_fault_ends_a_program_with_one_sentence(program, words, message, tmp_path):
    said = called(program, *words, "evaluation.gif=false", cwd=tmp_path, code=2).stderr
    lines = [line for line in said.splitlines() if line.startswith(f"{program}: ")]
    (line,) = [line for line in lines if "frame/s" not in line]  # of the progress bar
    assert message in line
    assert "Traceback" not in said


@pytest.mark.slow
@pytest.mark.parametrize(("env", "is_kept"), [("TrainingOnly", False), ("TableOnly", True)])
def test_fault_says_how_to_go_on_with_what_is_kept(env, is_kept, tmp_path):
    words = [*TINY, "method=ppo", f"env.id=odd_parts:{env}", "evaluation.gif=false"]
    done = called("train", *words, cwd=tmp_path, code=2)
    going_on = "what is finished is kept: correct the cause and continue with coil-train resume="
    assert (going_on in done.stderr) == ("continue with" in done.stderr) == is_kept


@pytest.mark.slow
def test_env_that_ignores_its_seed_and_cannot_draw_is_trained_with_warnings(tmp_path):
    words = [*TINY, "method=ppo", "env.id=odd_parts:Unseeded", "evaluation.gif=true"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        called("train", *words, cwd=tmp_path)
    said = " ".join(str(each.message) for each in caught)
    assert "other values of observation: the env does not obey its seed" in said
    assert "no pictures of the env: render returned" in said
    assert (tmp_path / "run" / "evaluation.csv").exists()


@pytest.mark.slow
def test_flag_of_info_says_which_steps_count_and_a_run_is_measured_again(tmp_path):
    words = [*TINY, "method=ppo", "env.id=odd_parts:Told", "env.info=[late]"]
    measure = "evaluation.measures.after"
    counted = [f"{measure}.reduction=count", f"{measure}.where=[info,late]"]
    words += [f"{measure}.entry=[info,late]", *counted, "evaluation.gif=false"]
    called("train", *words, cwd=tmp_path)
    again = ["run=run", "trust=[odd_parts]", "hydra.run.dir=again", "env.info=[time]"]
    again.append("evaluation.measures.end={entry: [info, time], reduction: last}")
    called("evaluate", *again, cwd=tmp_path)
    found = {name: read_csv(tmp_path / name / "episodes.csv") for name in ("run", "again")}
    assert {row["after"] for row in found["run"]} == {"7.0"}, "steps 6 to 12"
    assert {row["after"] for row in found["again"]} == {"7.0"}
    assert {row["end"] for row in found["again"]} == {"12.0"}
    assert (tmp_path / "again" / "in_time.png").exists()
