"""Every method trains, evaluates and resumes with the same programs."""

import json
import shutil

import pytest
import torch
from programs import composed, read_csv
from tiny_runs import METHODS, TRACKS, trained

from coil_rl.config.python import open_run
from coil_rl.errors import UserError
from coil_rl.programs import evaluate
from coil_rl.programs.train import resume
from coil_rl.run import checkpoint
from coil_studies import Fallback


@pytest.fixture(scope="module")
def proxies(tmp_path_factory):
    return f"proxy.folder={tmp_path_factory.mktemp('proxies')}"


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_method_ends_with_the_same_files_after_a_resume(method, proxies, tmp_path, capsys):
    run = trained(tmp_path / "run", method, proxies, "track.test.count=1")
    stopped = tmp_path / "stopped"
    shutil.copytree(run, stopped)
    for name in ("evaluation.csv", "policy_last.pt", "checkpoint.pt"):
        (stopped / name).unlink(missing_ok=True)
    resume(stopped)
    for name in ("policy_last.pt", "metrics.csv", "evaluation.csv", "episodes.csv"):
        is_written = method != "guide" or name in ("evaluation.csv", "episodes.csv")
        assert (run / name).exists() == (stopped / name).exists() == is_written
        if is_written:
            assert (run / name).read_bytes() == (stopped / name).read_bytes()
    assert method == "guide" or "continues after " in capsys.readouterr().err


@pytest.fixture(scope="module")
def residual(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("runs") / "residual", "residual", "label=mine")


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("runs") / "ppo", "ppo")


def rows(folder, **where):
    found = read_csv(folder / "evaluation.csv")
    return [row for row in found if where.items() <= row.items()]


def evaluated(run, folder, *words):
    """Evaluate a run into a folder."""
    words = [*TRACKS, f"run={run}", "evaluation.repeats=1", f"run_dir={folder}", *words]
    evaluate.evaluate(composed(*words, name="evaluate"))


@pytest.mark.slow
def test_existing_resume_does_not_repeat_a_finished_run(residual, capsys):
    before = {file: file.stat().st_mtime_ns for file in residual.iterdir() if file.name != ".lock"}
    trained(residual, "residual", "label=mine", "existing=resume")
    assert {file: file.stat().st_mtime_ns for file in before} == before
    assert "mine: mean test reward" in capsys.readouterr().out
    with pytest.raises(UserError, match=r"residual holds a run with learner.gamma=0.99, not 0.9"):
        trained(residual, "residual", "label=mine", "existing=resume", "learner.gamma=0.9")


@pytest.mark.slow
def test_trained_agent_is_evaluated_with_other_advice(residual, tmp_path):
    evaluated(residual, tmp_path, "degrade=[zeroed,adversarial]")
    assert {row["driver"] for row in rows(tmp_path)} == {"guide", "mine"}
    normal, zeroed, adversarial = (
        rows(tmp_path, driver="mine", actions="deterministic", advice=name)
        for name in ("", "zeroed", "adversarial")
    )
    trained_rows = rows(residual, driver="mine", actions="deterministic")
    assert [row["reward"] for row in normal] == [row["reward"] for row in trained_rows]
    assert len({row["reward"] for row in (normal[-1], zeroed[-1], adversarial[-1])}) == 3


@pytest.mark.slow
def test_rfc_logs_the_reward_of_the_task_alone(tmp_path, plain):
    # Before the first update its numbers are those of plain PPO.
    coupled = trained(tmp_path / "rfc", "rfc", "method.transforms.coupling.beta=1000")
    first, other = (read_csv(run / "metrics.csv")[1] for run in (coupled, plain))
    same = [key for key in other if key.startswith("train/")]
    assert {key: first[key] for key in same} == {key: other[key] for key in same}
    assert float(first["train/guide_distance"]) > 0
    assert first["learner/loss_critic"] != other["learner/loss_critic"]


@pytest.mark.slow
def test_jump_start_without_steps_is_ppo_to_the_bit(tmp_path, plain):
    jumped = trained(tmp_path / "jump", "jump_start", "method.transforms.jump_start.horizon=0")
    first, other = (checkpoint.load(run / "policy_last.pt") for run in (jumped, plain))
    assert all(torch.equal(first[key], other[key]) for key in other)


@pytest.mark.slow
def test_residual_of_scale_zero_is_the_guide(tmp_path):
    run = trained(tmp_path / "run", "residual", "method.transforms.residual.scale=0")
    guide, agent = rows(run, driver="guide"), rows(run, driver="residual", actions="deterministic")
    assert [row["reward"] for row in agent] == [row["reward"] for row in guide]


@pytest.mark.slow
def test_first_round_of_dagger_collects_the_data_of_oil(tmp_path):
    given = ["learner.validate=false", "env.assignment=cyclic", "budget.frames=64"]
    oil = trained(tmp_path / "oil", "oil", *given)
    dagger = trained(tmp_path / "dagger", "dagger", *given)
    gathered, other = (checkpoint.load(run / "dataset.pt") for run in (oil, dagger))
    assert len(gathered["action"]) == 64
    assert all(torch.equal(gathered[key], other[key]) for key in ("observation", "action"))


@pytest.mark.slow
def test_every_one_of_several_guides_is_evaluated(tmp_path):
    run = trained(tmp_path / "run", "coil_multi", "guide=[zero,spline]")
    drivers = [row["driver"] for row in rows(run, case="mean")]
    assert drivers == ["guide zero", "guide spline", "coil_multi", "coil_multi"]
    returns = json.loads((run / "guide_return.json").read_text())
    assert list(returns) == ["guide zero", "guide spline"]
    alone = trained(tmp_path / "alone", "guide")
    assert rows(run, driver="guide spline")[0]["reward"] == rows(alone)[0]["reward"]
    degraded = trained(tmp_path / "degraded", "guide", "degrade=[adversarial]")
    assert rows(degraded)[0]["reward"] != rows(alone)[0]["reward"]


@pytest.mark.slow
def test_agent_falls_back_to_its_guide_where_its_critic_values_a_state_low(tmp_path, plain):
    run = trained(tmp_path / "run", "coil")
    evaluated(run, tmp_path, "beside=fallback")
    text = (tmp_path / "evaluation.md").read_text()
    assert "With fallback the guide acted in " in text
    assert "Not worse than guide on these 2 cases: " in text
    assert len(rows(tmp_path, driver="coil or guide")) == 3
    with pytest.raises(UserError, match=r"no effect on .*ppo: its agent has no guide"):
        Fallback().driver(open_run(plain), torch.nn.Module())
