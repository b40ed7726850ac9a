import math

import numpy as np
import pytest
import torch
from any_env import AnyEnv
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Unbounded
from torchrl.modules import RandomPolicy
from worlds import Script, driving_measures

from coil_rl.envs import ConeTrackEnv, DrivingTasksEnv, Track, random_tracks
from coil_rl.guides import ConstantGuide, SplineGuide
from coil_rl.learners.networks import actor
from coil_rl.measures import REDUCTIONS, Measure, summarise
from coil_rl.run.evaluation import Totals, evaluate_policy
from coil_rl.run.policy_batch import Acting, OnRows

TRACKS = random_tracks(2, seed=5)
DRIVING = driving_measures()


@pytest.mark.slow
def test_measures_of_a_guide_that_completes_its_laps(ring):
    tracks = [ring, Track("wider", 1.1 * ring.left, 1.1 * ring.right)]
    env = ConeTrackEnv(tracks, 2, assignment="cyclic", laps=1, rate=6)
    options = {
        "cases": [track.name for track in tracks],
        "measures": DRIVING,
        "record": {"pose": ("info", "pose")},
    }
    result = evaluate_policy(env, SplineGuide(), **options)
    assert result.rate == 6
    for track, row, poses in zip(tracks, result.episodes, result.histories["pose"], strict=True):
        assert (row["case"], row["completed"], row["crashed"], row["laps"]) == (
            track.name,
            True,
            False,
            1,
        )
        assert row["clearance"] > 0
        # The middle line at 2 m/s; the guide cuts corners.
        assert row["lap_time"] == pytest.approx(track.length / 2, rel=0.05)
        assert poses.shape == (row["steps"], 3)
        assert row["steps"] >= row["lap_time"] * 6
    again = evaluate_policy(env, SplineGuide(), **options)
    assert again.episodes == result.episodes


def test_measures_of_a_crash():
    env = ConeTrackEnv(TRACKS, 4, assignment="cyclic")
    result = evaluate_policy(env, ConstantGuide(1.0), measures=DRIVING)
    for row in result.episodes:
        assert (row["crashed"], row["completed"]) == (True, False)
        assert math.isnan(row["lap_time"])
        assert row["clearance"] <= 0
        assert -100 < row["reward"] < -80
        terms = [value for name, value in row.items() if name.startswith("reward_")]
        assert len(terms) == 5
        assert sum(terms) == pytest.approx(row["reward"], rel=1e-5)


def test_return_of_several_agents_is_the_sum_of_their_rewards():
    env = AnyEnv(
        4, Bounded(-1, 1, (3, 2)), {("agents", "observation"): Unbounded((3, 4))}, agents=True
    )
    still = TensorDictModule(
        lambda seen: 0 * seen[..., :2], [("agents", "observation")], [("agents", "action")]
    )
    rows = evaluate_policy(
        env, still, measures={"each": Measure(("agents", "reward"), "min")}
    ).episodes
    assert [(row["reward"], row["steps"]) for row in rows] == [
        (pytest.approx(3 * 5 * -0.25), 5)
    ] * 4
    assert rows[0]["each"] == pytest.approx(-0.75)


@pytest.mark.slow
def test_sampled_actions_are_less_smooth_than_deterministic_ones():
    env = ConeTrackEnv(TRACKS, 2, assignment="cyclic", rate=8)
    policy = actor(env, ["observation"])
    plain, drawn = (
        evaluate_policy(env, policy, sampled=sampled, measures=DRIVING).episodes[0]["smoothness"]
        for sampled in (False, True)
    )
    assert drawn > 10 * plain
    mixed = OnRows([Acting(policy), Acting(policy, sampled=True)])
    mixed = evaluate_policy(env, mixed, measures=DRIVING).episodes
    assert mixed[0]["smoothness"] == pytest.approx(plain, rel=0.01)
    assert mixed[1]["smoothness"] > 10 * plain


def test_reward_of_each_task_is_measured():
    tasks = {
        "left": {"alive": 1.0, "crash": 0.0, "cone": 0.0},
        "right": {"alive": -1.0, "crash": 0.0, "cone": 0.0},
    }
    env = DrivingTasksEnv(
        TRACKS, 6, assignment="cyclic", tasks=tasks, duration=0.5, reward={"smooth": 0.0}
    )
    measures = {
        name: driving_measures("driving_tasks")[name]
        for name in ("per_step_left", "per_step_right")
    }
    record = {"reward": "reward", "left": ("info", "task", "left")}
    result = evaluate_policy(
        env, ConstantGuide(1.0), measures=measures, record=record, cases=["a", "b"]
    )
    for row, rewards, left in zip(result.episodes, *result.histories.values(), strict=True):
        assert row["reward"] == pytest.approx(rewards.sum())
        # Every step but that of the crash.
        assert (rewards[:-1] == np.where(left, 1, -1)[:-1]).all()
        for task, steps in {"left": left == 1, "right": left == 0}.items():
            mean = rewards[steps].mean() if steps.any() else math.nan
            assert row[f"per_step_{task}"] == pytest.approx(mean, nan_ok=True)
    *rows, mean = summarise(result.episodes, measures)
    assert all(0.8 < row["per_step_left"] <= 1 for row in rows)
    assert mean["per_step_left"] == pytest.approx(sum(row["per_step_left"] for row in rows) / 2)
    env = DrivingTasksEnv(
        TRACKS, 2, assignment="cyclic", tasks={"left": {}, "right": {}}, only="left"
    )
    *_, mean = summarise(
        evaluate_policy(env, ConstantGuide(1.0), measures=measures).episodes, measures
    )
    assert math.isnan(mean["per_step_right"]), "there are no steps of the task"


def script(*batch, dtype=torch.float32):
    """Episodes of 1 to 13 steps with random numbers, of which a third are 0, and random flags."""
    draw = torch.Generator().manual_seed(3)
    lengths = torch.randint(1, 14, batch, generator=draw)
    lengths.view(-1)[:2] = torch.tensor([1, 13])[: lengths.numel()]
    number = torch.randn(16, *batch, 1, generator=draw, dtype=dtype)
    number *= torch.rand(16, *batch, 1, generator=draw) > 1 / 3
    flag = torch.rand(16, *batch, 1, generator=draw) > 0.7
    flag.view(16, -1)[:, 1:2] = False  # a row without any
    place = torch.randn(16, *batch, 2, generator=draw, dtype=dtype)
    reward = torch.randn(16, *batch, 1, generator=draw, dtype=dtype)
    return Script(lengths, reward, number=number, flag=flag, place=place, plain=number.squeeze(-1))


def of_rows(env, name):
    """Return the numbers of an entry in each episode."""
    values, lengths = env.entries[name].double().numpy(), env.lengths.numpy().reshape(-1)
    values = values.reshape(16, len(lengths), *values.shape[1 + env.batch_dims :])
    return [values[:length, row] for row, length in enumerate(lengths)]


REDUCE = {
    "mean": np.mean,
    "sum": np.sum,
    "min": np.min,
    "max": np.max,
    "last": lambda x: x[-1],
    "any": np.any,
    "count": np.count_nonzero,
    "mean_nonzero": lambda x: x[x != 0].mean() if x.any() else math.nan,
}
OF_NOTHING = dict.fromkeys(REDUCTIONS, math.nan) | {"sum": 0, "any": False, "count": 0}


def test_nan_is_no_event_and_shows_in_means():
    totals = Totals({reduction: Measure("number", reduction) for reduction in REDUCTIONS})
    for number in (0.0, math.nan, 0.0):
        after = TensorDict({"number": torch.tensor([[number]])}, [1])
        totals.add(after, torch.ones(1, 1, dtype=torch.bool))
    found = {name: value.item() for name, value in totals.results().items()}
    assert (found["any"], found["count"], found["min"], found["max"]) == (False, 0, 0, 0)
    assert all(math.isnan(found[name]) for name in ("mean", "sum", "mean_nonzero"))


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_steps_without_a_number_of_info_do_not_count(reduction):
    measures = {"all": Measure(("info", "x"), reduction), "none": Measure(("info", "y"), reduction)}
    totals, numbers = Totals(measures), [3.0, math.nan, 0.0, 5.0, math.nan]
    for number in numbers:
        info = {"x": torch.tensor([[number]]), "y": torch.tensor([[math.nan]])}
        after = TensorDict({"info": info}, [1])
        totals.add(after, torch.ones(1, 1, dtype=torch.bool))
    found = {name: value.item() for name, value in totals.results().items()}
    assert found["all"] == REDUCE[reduction](np.array([3.0, 0.0, 5.0]))
    assert found["none"] == pytest.approx(OF_NOTHING[reduction], nan_ok=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.int64, torch.bool])
def test_number_is_a_flag_where_it_is_neither_zero_nor_missing(dtype):
    measures = {"sum": Measure("x", "sum", ("info", "on")), "count": Measure("x", "count")}
    totals = Totals(measures)
    steps = [(1.0, 1.0), (2.0, 0.0), (4.0, -1.0)]
    if dtype.is_floating_point:
        steps.append((8.0, math.nan))
    for number, flag in steps:
        entries = {"x": torch.tensor([[number]]), "info": {"on": torch.tensor([[flag]]).to(dtype)}}
        totals.add(TensorDict(entries, [1]), torch.ones(1, 1, dtype=torch.bool))
    found = {name: value.item() for name, value in totals.results().items()}
    assert found == {"sum": 5.0, "count": len(steps)}


def test_last_number_is_that_of_the_last_step_that_has_one():
    totals = Totals({"last": Measure("number", "last")})
    for step in ([0.0, math.nan], [2.0, math.nan], [math.nan, math.nan]):
        after = TensorDict({"number": torch.tensor(step)[:, None]}, [2])
        totals.add(after, torch.ones(2, 1, dtype=torch.bool))
    assert totals.results()["last"].tolist() == pytest.approx([2.0, math.nan], nan_ok=True)


@pytest.mark.parametrize("bound", ["at_least", "at_most"])
@pytest.mark.parametrize("reduction", ["mean", "sum", "mean_nonzero", "last", "min", "max"])
def test_bound_of_a_mean_or_sum_that_is_nan_is_undecided(reduction, bound):
    totals = Totals({"flag": Measure("number", reduction, **{bound: 1.0})})
    after = TensorDict({"number": torch.tensor([[1.0], [math.nan]])}, [2])
    totals.add(after, torch.ones(2, 1, dtype=torch.bool))
    within, without = totals.results()["flag"].tolist()
    assert within == 1
    assert math.isnan(without) if reduction in ("mean", "sum", "mean_nonzero") else not without


@pytest.mark.parametrize("batch", [(), (7,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_measures_are_those_of_numpy(batch, dtype):
    env = script(*batch, dtype=dtype)
    measures = {
        f"{reduction} {where}": Measure("number", reduction, where)
        for reduction in REDUCTIONS
        for where in (None, "flag")
    }
    result = evaluate_policy(env, RandomPolicy(env.action_spec), measures=measures)
    flags = of_rows(env, "flag")
    for row, numbers, flag in zip(result.episodes, of_rows(env, "number"), flags, strict=True):
        for name, found in list(row.items())[3:]:
            reduction, _, where = name.partition(" ")
            counted = numbers[flag == 1] if where == "flag" else numbers[:, 0]
            expected = REDUCE[reduction](counted) if len(counted) else OF_NOTHING[reduction]
            assert found == pytest.approx(expected, rel=1e-12, nan_ok=True), name
            assert isinstance(found, bool) == (reduction == "any")


def test_bounds_make_flags_and_nan_is_within_no_bound():
    env = script(7)
    bounds = {"at_least": 0.5, "at_most": 0.5}
    measures = {
        f"{reduction} {bound}": Measure("number", reduction, "flag", **{bound: value})
        for reduction in ("max", "mean")
        for bound, value in bounds.items()
    }
    result = evaluate_policy(env, RandomPolicy(env.action_spec), measures=measures)
    for row, numbers, flag in zip(
        result.episodes, of_rows(env, "number"), of_rows(env, "flag"), strict=True
    ):
        for reduction in ("max", "mean"):
            number = REDUCE[reduction](numbers[flag == 1]) if flag.any() else math.nan
            assert [row[f"{reduction} {bound}"] for bound in bounds] == [
                number >= 0.5,
                number <= 0.5,
            ]


def test_totals_can_be_read_during_the_episodes():
    env = script(7)
    totals, measure = Totals({"sum": Measure("number", "sum")}), of_rows(env, "number")
    for time in range(3):
        totals.add(env.step(env.rand_action())["next"], time < env.lengths)
        expected = [numbers[: time + 1].sum() for numbers in measure]
        assert totals.results()["sum"].tolist() == pytest.approx(expected)
        assert totals.steps.tolist() == env.lengths.view(-1).clamp(max=time + 1).tolist()


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3)])
def test_env_of_any_batch_is_evaluated_row_by_row(batch):
    env = script(*batch)
    record = {"place": "place", "number": "number", "plain": "plain"}
    ticks = []
    result = evaluate_policy(
        env,
        RandomPolicy(env.action_spec),
        record=record,
        cases=["a", "b"],
        tick=lambda: ticks.append(1),
    )
    rows = math.prod(batch)
    assert [episode["case"] for episode in result.episodes] == [*"ababab"][:rows]
    assert [episode["steps"] for episode in result.episodes] == env.lengths.view(-1).tolist()
    rewards = [float(each.sum()) for each in of_rows(env, "reward")]
    assert [episode["reward"] for episode in result.episodes] == pytest.approx(rewards)
    assert result.mean_reward == pytest.approx(sum(rewards) / rows)
    for name, shape in {"place": (2,), "number": (), "plain": ()}.items():
        for found, expected in zip(result.histories[name], of_rows(env, name), strict=True):
            np.testing.assert_array_equal(found, expected.reshape(-1, *shape))
    assert max(env.lengths.view(-1).tolist()) <= len(ticks) + 1 <= 16
    numbered = evaluate_policy(env, RandomPolicy(env.action_spec))
    assert [episode["case"] for episode in numbered.episodes] == list(map(str, range(rows)))
    assert not numbered.histories


def test_parts_of_a_result_keep_their_histories():
    env = script(6)
    whole = evaluate_policy(
        env, RandomPolicy(env.action_spec), record={"place": "place"}, cases=["a", "b", "c"]
    )
    first, second = whole[:3], whole[3:]
    assert [*first.episodes, *second.episodes] == whole.episodes
    assert [episode["case"] for episode in second.episodes] == ["a", "b", "c"]
    assert [*first.histories["place"], *second.histories["place"]] == whole.histories["place"]
    assert first.rate == second.rate == 5
