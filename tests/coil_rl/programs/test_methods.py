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
from coil_rl.record import DELIVERY
from coil_rl.run import checkpoint
from coil_studies import Fallback


@pytest.fixture(scope="module")
def proxies(tmp_path_factory):
    return f"proxy.folder={tmp_path_factory.mktemp('proxies')}"


TESTED = (DELIVERY.name, "policy_handed_over.pt")
WITH_MEMORY = [f"{method} network=gru" for method in ("ppo", "coil", "jump_start")]


@pytest.mark.slow
@pytest.mark.parametrize("words", [*METHODS, *WITH_MEMORY])
def test_method_ends_with_the_same_files_after_a_resume(words, proxies, tmp_path, capsys):
    method, *network = words.split()
    run = trained(tmp_path / "run", method, *network, proxies, "track.test.count=1")
    stopped = tmp_path / "stopped"
    shutil.copytree(run, stopped)
    for name in ("evaluation.csv", "policy_last.pt", "checkpoint.pt", *TESTED):
        (stopped / name).unlink(missing_ok=True)
    resume(stopped)
    names = ["policy_last.pt", "metrics.csv", "evaluation.csv", "episodes.csv", *TESTED]
    written = [name for name in names if (run / name).exists()]
    assert ("metrics.csv" in written) == ("policy_last.pt" in written) == (method != "guide")
    assert (DELIVERY.name in written) == (method in ("coil_anchored", "tune"))
    for name in {"evaluation.csv", "episodes.csv", *written}:
        assert (run / name).read_bytes() == (stopped / name).read_bytes(), name
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
