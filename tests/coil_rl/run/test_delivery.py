"""What a run hands over: its last policy, an earlier one, or its guide."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from programs import called, composed, read_csv

from coil_rl import open_run
from coil_rl.config.assemble import assemble
from coil_rl.config.parts import env_maker
from coil_rl.guides.simple import FollowAdvice
from coil_rl.record import DELIVERY
from coil_rl.run import checkpoint
from coil_rl.run.cases import TrainingCases
from coil_rl.run.delivery import GUIDE, Delivery, GuideActs
from coil_rl.run.parts import TESTS

pytest.importorskip("gymnasium.envs.classic_control")
SMALL = ["env=pendulum", "env.max_steps=40", "logger=none", "delivery=tested"]
SMALL += ["budget.frames=6000", "budget.num_envs=4", "budget.steps=50", "budget.minibatches=2"]
SMALL += ["evaluation.cases=2", "evaluation.curve.num_envs=2", "evaluation.curve.points=2"]
SMALL += ["evaluation.gif=false"]
ONCE = "learner.epochs=1"  # for what does not depend on how much is learned


def trained(folder, *overrides):
    called("train", *SMALL, *overrides, f"hydra.run.dir={folder}", cwd=folder.parent)
    return folder


def report(folder):
    return json.loads((folder / DELIVERY.name).read_text())


@pytest.fixture(scope="module")
def guide_wins(tmp_path_factory):
    """A run of COIL that learns nothing, so that its guide is better than any of its policies."""
    folder = tmp_path_factory.mktemp("delivery") / "run"
    disturbed = ["disturb=[action_delay,observation_noise]", "disturb.action_delay.max_lag=6"]
    return trained(folder, "method=coil", "training.learning_rate=0", ONCE, *disturbed)


def deterministic(folder):
    """Return the rewards of all drivers with deterministic actions, by case."""
    rewards = {}
    for row in read_csv(folder / "evaluation.csv"):
        if row["actions"] == "deterministic":
            rewards.setdefault(row["driver"], {})[row["case"]] = row["reward"]
    return rewards


@pytest.mark.slow
def test_guide_is_handed_over_where_nothing_better_was_learned(guide_wins):
    curve = [row["evaluation/return"] for row in read_csv(guide_wins / "metrics.csv")]
    assert len(set(curve) - {"nan"}) == 1 < len(curve)  # no policy learned anything
    found = report(guide_wins)
    assert found["policy"] == "guide"
    assert found["returns"]["guide"] == max(found["returns"].values())
    assert checkpoint.load(guide_wins / "policy_handed_over.pt") == {GUIDE: torch.tensor(0)}
    guide, agent = deterministic(guide_wins).values()
    assert agent == guide  # whatever disturbs the env
    page = (guide_wins / "evaluation.md").read_text()
    assert "Handed over is the guide itself, and nothing that was learned" in page
    assert "the return is the same in each of them" in page
    mean, low, high = found["ahead"]
    assert mean == pytest.approx(found["returns"]["guide"] - found["returns"]["last"], rel=1e-4)
    assert low <= mean <= high
    listed = called("report", f"folder={guide_wins.parent}").stdout
    assert "whose steps are among their frames: guide 1." in listed


@pytest.mark.slow
def test_controller_of_a_handed_over_guide_does_what_the_guide_does(guide_wins):
    run = open_run(guide_wins)
    controller, env = run.controller(), run.make_env(1)
    data = env.reset()
    expected = GuideActs(env)(data.clone())["action"]
    torch.testing.assert_close(controller.act_on(data.clone())[0], 2 * expected[0])
    assert not isinstance(run.controller("last").policy, GuideActs)


@pytest.mark.slow
def test_handed_over_guide_is_not_listened_to(guide_wins, tmp_path):
    refused = called("listen", f"run={guide_wins}", cwd=tmp_path, code=2).stderr
    assert "handed over its guide, which uses no advice; write evaluation.policy=last" in refused
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_every_step_is_a_frame_and_the_log_has_the_parts(guide_wins):
    rows = read_csv(guide_wins / "metrics.csv")
    last = {name: float(value) for name, value in rows[-1].items() if name.startswith("frames")}
    assert last["frames"] == last["frames/rollout"] + last["frames/tests"] + last["frames/before"]
    assert last["frames/tests"] == report(guide_wins)["steps"] > 0
    assert last["frames"] <= 6000
    assert last["frames/tests"] <= 0.1 * 6000
    assert float(rows[-1]["guide/calls"]) > last["frames"]


@pytest.mark.parametrize(
    ("taken", "ahead", "kept"),
    [(0, False, 50), (50, False, 50), (70, False, 30), (120, False, 0), (120, True, 50)],
)
def test_test_at_the_end_gets_what_the_start_test_leaves_of_a_tenth(taken, ahead, kept, tmp_path):
    cases = TrainingCases(build=GuideActs, frames=1000)
    cases.steps, cases.guide_ahead = taken, ahead
    delivery = Delivery(learner=None, env=None, cases=cases, curve=None, folder=tmp_path)
    assert delivery.reserve() == kept


@pytest.mark.parametrize(("finished", "fits"), [(80.0, True), (4.0, False)])
def test_long_episodes_of_a_training_without_a_curve_leave_no_test(finished, fits, tmp_path):
    words = ["env=pendulum", "method=coil", "delivery=tested", "budget.num_envs=2"]
    run = assemble(composed(*words, "budget.frames=6000", f"run_dir={tmp_path}"))
    run.make_env = replace(run.make_env, sizes={})
    training = run.training(0)
    (delivery,) = (each for each in training.callbacks if isinstance(each, Delivery))
    training.metrics.rows = [{"train/episodes": finished, "frames/rollout": 800}]
    training.curve.attach(training.metrics, [1], frames=800, before=0)
    # Two cases with policy and guide, in 300 frames.
    assert delivery._fits() == fits
    assert training.curve.kept() == []


class CountedCases(TrainingCases):
    """Cases in which every episode of every policy has a number of steps."""

    length = 0

    def compared(self, policies, sampled=None):
        self.steps += self.length * self.count * len(policies)
        return [torch.zeros(self.count) for _ in policies]


@pytest.mark.parametrize(("length", "is_compared"), [(8, True), (9, False)])
def test_earlier_policy_is_compared_if_its_episodes_fit(length, is_compared, monkeypatch, tmp_path):
    # The test has 50 frames; two cases take 2 x `length` for each of three policies.
    monkeypatch.setattr("coil_rl.run.delivery.policy_of", lambda state, *given: state)
    cases = CountedCases(build=lambda rows: None, frames=1000)
    cases.length = length
    cases.teach([], lambda steps: None)
    learner = SimpleNamespace(policy=None)
    delivery = Delivery(learner=learner, env=None, cases=cases, curve=None, folder=tmp_path)
    delivery.cases.renew = lambda count: setattr(cases, "count", count)
    returns = delivery._tested({name: {} for name in ("last", "guide", "earlier")})
    assert ("earlier" in returns) == is_compared
    assert cases.taught is None  # what is handed over is the policy that was tested


@pytest.mark.parametrize("chosen", ["last", "earlier"])
def test_frames_of_an_earlier_policy_are_those_of_the_log(chosen, tmp_path):
    """The file of a policy that a longer run kept does not count the test at the first end."""
    curve = SimpleNamespace(metrics=SimpleNamespace(rows=[{"frames": 0}, {"frames": 260}]))
    cases = TrainingCases(build=GuideActs, frames=1000)
    delivery = Delivery(learner=None, env=None, cases=cases, curve=curve, folder=tmp_path)
    delivery._report(chosen, {}, dict.fromkeys(("last", "earlier"), torch.zeros(2)), 1)
    assert report(tmp_path)["frames"] == (260 if chosen == "earlier" else None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "frames", "steps"),
    [
        # Two cases of 40 steps with the guide, its opposite and the new policy, which hold none.
        (["method=coil_anchored", "degrade=[random]"], 2400, 2 * 3 * 40),
        # No start test; two cases with two policies are more than 5 % of the frames.
        (["method=coil"], 1200, 0),
    ],
)
def test_test_at_the_end_is_left_out_where_no_frames_are_left_for_it(
    words, frames, steps, tmp_path
):
    run = trained(tmp_path / "run", ONCE, *words, f"budget.frames={frames}", "budget.num_envs=2")
    last = read_csv(run / "metrics.csv")[-1]
    assert float(last["frames/tests"]) == steps
    assert 0.9 * frames < float(last["frames"]) <= frames
    assert report(run)["policy"] == "last_untested"
    state, given = (checkpoint.load(run / f"policy_{name}.pt") for name in ("last", "handed_over"))
    assert all(torch.equal(state[key], given[key]) for key in state)


@pytest.mark.slow
@pytest.mark.parametrize("frames", [700, 2400])
def test_guide_that_was_ahead_but_not_held_is_tested_at_the_end(frames, tmp_path):
    small = ["method=coil_anchored", f"budget.frames={frames}", "budget.num_envs=2"]
    run = trained(tmp_path / "run", ONCE, *small)
    first, *_, last = read_csv(run / "metrics.csv")
    assert float(first["start/weight"]) == 0
    assert float(first["start/guide"]) > float(first["start/new"])
    # Two cases of 40 steps with guide and policy, though the start test has taken its share, and
    # with 700 frames more than both tests may take together.
    assert float(last["delivery/cases"]) == 2
    found = report(run)
    assert found["returns"]["guide"] > found["returns"]["last"]
    assert found["policy"] == "guide"
    assert float(last["frames"]) <= frames


@pytest.mark.slow
@pytest.mark.parametrize("frames", [8000, 11_000])  # for three and for four cases
def test_placebo_of_other_rows_always_has_other_rows(frames, tmp_path):
    settings = [f"budget.frames={frames}", "degrade=[shuffled]", "training.learning_rate=0"]
    run = trained(tmp_path / "run", "method=coil", *settings)
    assert report(run)["cases"] in (2, 4)


@pytest.mark.slow
def test_learned_policy_is_handed_over_where_it_is_better(tmp_path):
    folder = trained(tmp_path / "run", "method=coil", "degrade=[random]", "guide=constant")
    found = report(folder)
    best = max(found["returns"], key=found["returns"].get)
    assert found["policy"] == best
    name = {"last": "policy_last.pt"}.get(best, f"policies/{found['frames'] or 0:012d}.pt")
    if best != "guide":
        state, given = (checkpoint.load(folder / file) for file in ("policy_handed_over.pt", name))
        assert state.keys() == given.keys()
        assert all(torch.equal(state[key], given[key]) for key in state)


@pytest.mark.fast("residual")
@pytest.mark.parametrize(
    "method", ["coil", "residual", "residual_coil", "mixing", "jump_start", "policy_decorator"]
)
def test_guide_acts_alone_also_where_actions_are_combined(method):
    make_env = env_maker(composed(f"method={method}", "env=pendulum", "run_dir=unused"))
    combined = TrainingCases(lambda rows: make_env(rows, TESTS), 10_000)
    alone = TrainingCases(lambda rows: make_env.guided(rows, TESTS)[0], 10_000)
    for cases in (combined, alone):
        cases.renew(2)
    expected = alone.returns(FollowAdvice(alone.env))
    torch.testing.assert_close(combined.returns(GuideActs(combined.env)), expected)


@pytest.mark.slow
def test_run_without_a_guide_in_its_env_compares_its_own_policies(tmp_path):
    folder = trained(tmp_path / "run", "method=ppo", ONCE)
    assert set(report(folder)["returns"]) <= {"last", "earlier"}
    assert math.isnan(float(read_csv(folder / "metrics.csv")[-1]["delivery/guide"]))
