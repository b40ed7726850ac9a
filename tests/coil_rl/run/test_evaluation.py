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
    options = {"cases": ["ring", "wider"], "measures": DRIVING}
    options |= {"record": {"pose": ("info", "pose")}}
    result = evaluate_policy(env, SplineGuide(), **options)
    assert result.rate == 6
    for track, row, poses in zip(tracks, result.episodes, result.histories["pose"], strict=True):
        assert row["case"] == track.name
        assert (row["completed"], row["crashed"], row["laps"]) == (True, False, 1)
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
    seen, action = ("agents", "observation"), ("agents", "action")
    env = AnyEnv(4, Bounded(-1, 1, (3, 2)), {seen: Unbounded((3, 4))}, agents=True)
    still = TensorDictModule(lambda seen: 0 * seen[..., :2], [seen], [action])
    measures = {"each": Measure(("agents", "reward"), "min")}
    rows = evaluate_policy(env, still, measures=measures).episodes
    assert [row["steps"] for row in rows] == [5] * 4
    assert [row["reward"] for row in rows] == pytest.approx([3 * 5 * -0.25] * 4)
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
    rewards = {"crash": 0.0, "cone": 0.0, "smooth": 0.0}
    tasks = {"left": {"alive": 1.0}, "right": {"alive": -1.0}}
    env = DrivingTasksEnv(TRACKS, 6, assignment="cyclic", tasks=tasks, duration=0.5, reward=rewards)
    of_env = driving_measures("driving_tasks")
    measures = {name: of_env[name] for name in ("per_step_left", "per_step_right")}
    record = {"reward": "reward", "left": ("info", "task", "left")}
    options = {"measures": measures, "record": record, "cases": ["a", "b"]}
    result = evaluate_policy(env, ConstantGuide(1.0), **options)
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
    env = DrivingTasksEnv(TRACKS, 2, assignment="cyclic", tasks=tasks, only="left")
    result = evaluate_policy(env, ConstantGuide(1.0), measures=measures)
    *_, mean = summarise(result.episodes, measures)
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


def results(measures, *steps):
    """Return the results, [N] of each measure, of N episodes that show these entries, [N] each."""
    totals = Totals(measures)
    for step in steps:
        entries = {name: torch.tensor(values).unsqueeze(-1) for name, values in step.items()}
        running = torch.ones(len(next(iter(step.values()))), 1, dtype=torch.bool)
        totals.add(TensorDict(entries, [len(running)]), running)
    return {name: value.tolist() for name, value in totals.results().items()}


def test_nan_is_no_event_and_shows_in_means():
    measures = {reduction: Measure("number", reduction) for reduction in REDUCTIONS}
    found = results(measures, *({"number": [number]} for number in (0.0, math.nan, 0.0)))
    nothing = {"any": [False], "count": [0], "min": [0], "max": [0]}
    assert {name: found[name] for name in nothing} == nothing
    assert all(math.isnan(*found[name]) for name in ("mean", "sum", "mean_nonzero"))


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_steps_without_a_number_of_info_do_not_count(reduction):
    x, y = ("info", "x"), ("info", "y")
    measures = {"all": Measure(x, reduction), "none": Measure(y, reduction)}
    numbers = [3.0, math.nan, 0.0, 5.0, math.nan]
    found = results(measures, *({x: [number], y: [math.nan]} for number in numbers))
    assert found["all"] == [REDUCE[reduction](np.array([3.0, 0.0, 5.0]))]
    assert found["none"] == pytest.approx([OF_NOTHING[reduction]], nan_ok=True)


@pytest.mark.parametrize("kind", [float, int, bool])
def test_number_is_a_flag_where_it_is_neither_zero_nor_missing(kind):
    measures = {"sum": Measure("x", "sum", ("info", "on")), "count": Measure("x", "count")}
    steps = [(1.0, kind(1)), (2.0, kind(0)), (4.0, kind(-1))]
    if kind is float:
        steps.append((8.0, math.nan))
    found = results(measures, *({"x": [number], ("info", "on"): [flag]} for number, flag in steps))
    assert found == {"sum": [5.0], "count": [len(steps)]}


def test_last_number_is_that_of_the_last_step_that_has_one():
    steps = ([0.0, math.nan], [2.0, math.nan], [math.nan, math.nan])
    found = results({"last": Measure("number", "last")}, *({"number": step} for step in steps))
    assert found["last"] == pytest.approx([2.0, math.nan], nan_ok=True)


@pytest.mark.parametrize("bound", ["at_least", "at_most"])
@pytest.mark.parametrize("reduction", ["mean", "sum", "mean_nonzero", "last", "min", "max"])
def test_bound_of_a_mean_or_sum_that_is_nan_is_undecided(reduction, bound):
    measures = {"flag": Measure("number", reduction, **{bound: 1.0})}
    within, without = results(measures, {"number": [1.0, math.nan]})["flag"]
    assert within == 1
    assert math.isnan(without) if reduction in ("mean", "sum", "mean_nonzero") else not without


@pytest.mark.parametrize("batch", [(), (7,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_measures_are_those_of_numpy(batch, dtype):
    env = script(*batch, dtype=dtype)
    measures = {}
    for reduction in REDUCTIONS:
        measures[reduction] = Measure("number", reduction)
        measures[f"{reduction} flag"] = Measure("number", reduction, "flag")
    result = evaluate_policy(env, RandomPolicy(env.action_spec), measures=measures)
    flags = of_rows(env, "flag")
    for row, numbers, flag in zip(result.episodes, of_rows(env, "number"), flags, strict=True):
        for name, found in list(row.items())[3:]:
            reduction, _, where = name.partition(" ")
            counted = numbers[flag == 1] if where == "flag" else numbers[:, 0]
            expected = REDUCE[reduction](counted) if len(counted) else OF_NOTHING[reduction]
            assert found == pytest.approx(expected, rel=1e-12, nan_ok=True), name
            assert isinstance(found, bool) == (reduction == "any")


@pytest.mark.parametrize("reduction", ["max", "mean"])
def test_bounds_make_flags_and_nan_is_within_no_bound(reduction):
    env = script(7)
    measures = {
        "at_least": Measure("number", reduction, "flag", at_least=0.5),
        "at_most": Measure("number", reduction, "flag", at_most=0.5),
    }
    result = evaluate_policy(env, RandomPolicy(env.action_spec), measures=measures)
    flags = of_rows(env, "flag")
    for row, numbers, flag in zip(result.episodes, of_rows(env, "number"), flags, strict=True):
        number = REDUCE[reduction](numbers[flag == 1]) if flag.any() else math.nan
        assert (row["at_least"], row["at_most"]) == (number >= 0.5, number <= 0.5)


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
    ticks, policy, rows = [], RandomPolicy(env.action_spec), math.prod(batch)
    options = {"cases": ["a", "b"], "tick": lambda: ticks.append(1)}
    result = evaluate_policy(env, policy, record=record, **options)
    assert [episode["case"] for episode in result.episodes] == [*"ababab"][:rows]
    assert [episode["steps"] for episode in result.episodes] == env.lengths.view(-1).tolist()
    rewards = [float(each.sum()) for each in of_rows(env, "reward")]
    assert [episode["reward"] for episode in result.episodes] == pytest.approx(rewards)
    assert result.mean_reward == pytest.approx(sum(rewards) / rows)
    for name, shape in {"place": (2,), "number": (), "plain": ()}.items():
        for found, expected in zip(result.histories[name], of_rows(env, name), strict=True):
            np.testing.assert_array_equal(found, expected.reshape(-1, *shape))
    assert max(env.lengths.view(-1).tolist()) <= len(ticks) + 1 <= 16
    numbered = evaluate_policy(env, policy)
    assert [episode["case"] for episode in numbered.episodes] == list(map(str, range(rows)))
    assert not numbered.histories


def test_parts_of_a_result_keep_their_histories():
    env = script(6)
    options = {"record": {"place": "place"}, "cases": ["a", "b", "c"]}
    whole = evaluate_policy(env, RandomPolicy(env.action_spec), **options)
    first, second = whole[:3], whole[3:]
    assert [*first.episodes, *second.episodes] == whole.episodes
    assert [episode["case"] for episode in second.episodes] == ["a", "b", "c"]
    assert [*first.histories["place"], *second.histories["place"]] == whole.histories["place"]
    assert first.rate == second.rate == 5
