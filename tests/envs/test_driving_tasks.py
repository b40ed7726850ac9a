import copy
import math

import pytest
import torch
from worlds import drive, same

from coil_rl.cones.spline import SplineGuide
from coil_rl.envs import ConeTrackEnv, DrivingTasksEnv
from coil_rl.testing import check_env

TASKS = {
    "centred": {"centre": -1.0},
    "corners": {"inside": 3.0},
    "left": {"left": 0.5, "alive": 0.25},
    "smooth": {"smooth": -5.0},
}
EQUAL = {"a": {}, "b": {}, "c": {}}


def rollout(env, steps):
    """Return steps under random steering, with resets, [B, T]."""
    torch.manual_seed(1)
    return env.rollout(steps, break_when_any_done=False)


def one_step(ring, position, action, **kwargs):
    """Drive one step to a lateral position on a round track, 1 at the left boundary; [1, ...]."""
    env = DrivingTasksEnv([ring], 1, tasks=TASKS, **kwargs)
    state = env.reset()
    length = env.speed / env.rate
    env.pose = torch.tensor([[5.0 - 1.3 * position], [-length], [math.pi / 2]])
    state["action"] = torch.tensor([[action]])
    after = env.step(state)["next"]
    return after


@pytest.mark.parametrize("kwargs", [{}, {"only": "left", "info": False, "dtype": torch.float64}])
def test_env_contract_holds(rings, kwargs):
    check_env(DrivingTasksEnv(rings, 3, tasks=TASKS, duration=0.2, **kwargs))


@pytest.mark.parametrize(
    ("task", "term", "reward"),
    [
        ("centred", "centre", -0.5),
        ("corners", "inside", -3 * 0.5 * 0.2),
        ("left", "left", -0.25),
        ("smooth", "left", 0),
    ],
)
def test_lateral_position_is_rewarded_by_the_task(ring, task, term, reward):
    after = one_step(ring, -0.5, 0.2, only=task)
    # The boundaries are splines through cones, nearly circles.
    assert after["info", "reward", term].item() == pytest.approx(reward, abs=0.01)
    assert after["info", "task", task].item()
    assert sum(entry.item() for entry in after["info", "task"].values()) == 1


def test_tasks_override_only_the_weights_they_set(ring):
    common = {"alive": 0.5, "left": 0.1, "cone": 0.0}
    steps = {task: one_step(ring, 0.4, 0.2, only=task, reward=common) for task in TASKS}
    rewards = {task: step["info", "reward"] for task, step in steps.items()}
    alive = {task: reward["alive"].item() for task, reward in rewards.items()}
    assert alive == {"centred": 0.5, "corners": 0.5, "left": 0.25, "smooth": 0.5}
    assert rewards["left"]["left"].item() == pytest.approx(5 * rewards["smooth"]["left"].item())
    assert rewards["smooth"]["smooth"].item() == pytest.approx(-5 * 0.2)
    assert rewards["left"]["smooth"].item() == pytest.approx(-0.1 * 0.2)


def test_crash_replaces_all_other_reward_terms(ring):
    after = one_step(ring, 0.95, 0.2, only="left")
    assert after["terminated"].all()
    assert after["reward"].item() == -100
    terms = after["info", "reward"]
    assert all(terms[term].item() == 0 for term in set(terms.keys()) - {"crash"})


@pytest.mark.slow
def test_tasks_without_weights_equal_the_cone_world(rings):
    shared = {"num_envs": 6, "assignment": "cyclic", "laps": 1, "rate": 6}
    envs = [
        ConeTrackEnv(rings, **shared),
        DrivingTasksEnv(rings, **shared, tasks=EQUAL, duration=1.0),
    ]
    states = [env.reset() for env in envs]
    guide, finished, crashed = SplineGuide(), 0, 0
    for _ in range(110):
        emitted = []
        for i, env in enumerate(envs):
            action = guide(states[i].copy())["action"]
            action[2:] = torch.linspace(0.2, 0.4, 4).unsqueeze(-1)
            states[i]["action"] = action
            step, states[i] = env.step_and_maybe_reset(states[i])
            emitted.append(step["next"])
        terms = emitted[1]["info", "reward"]
        assert all(terms.pop(term).eq(0).all() for term in ("centre", "left", "inside"))
        assert (emitted[0] == emitted[1].exclude("task", ("info", "task"))).all()
        finished += int(emitted[0]["info", "lap_time"].gt(0).sum())
        crashed += int(emitted[0]["info", "crashed"].sum())
    assert finished > 0
    assert crashed > 0


def test_observed_task_is_that_of_the_next_reward(rings):
    steps = rollout(DrivingTasksEnv(rings, 16, tasks=TASKS, duration=0.5), 60)
    rewarded = torch.cat(list(steps["next", "info", "task"].values()), -1)
    assert torch.equal(rewarded.float(), steps["task"])
    assert rewarded.sum(-1).eq(1).all()
    alive = ~steps["next", "info", "crashed"]
    nonzero = steps["next", "info", "reward", "left"].ne(0) & alive
    assert torch.equal(nonzero, steps["task"][..., 2:3].bool() & alive)
    assert steps["next", "task"].ne(steps["task"]).any(-1).sum() > 16


def test_task_durations_and_transitions_have_the_given_distribution(rings):
    env = DrivingTasksEnv(rings, 4096, tasks=EQUAL, duration=0.5)
    first = env.reset()["task"]
    assert first.mean(0).tolist() == pytest.approx([1 / 3] * 3, abs=0.03)
    pairs = torch.zeros(3, 3)
    for _ in range(40):
        before, env.task = env.task, env._next_task()
        pairs += torch.zeros(9).index_add(0, 3 * before + env.task, torch.ones(4096)).view(3, 3)
    stays = pairs.diagonal().sum() / pairs.sum()
    assert stays.item() == pytest.approx(1 - 1 / (0.5 * env.rate), abs=0.003)
    other = pairs[~torch.eye(3, dtype=torch.bool)]
    assert (other / other.sum()).tolist() == pytest.approx([1 / 6] * 6, abs=0.015)


def test_single_task_uses_no_random_numbers(rings):
    env = DrivingTasksEnv(rings, 8, tasks=TASKS, only="corners", duration=0.1, assignment="cyclic")
    before = env.generator.get_state()
    assert rollout(env, 30)["task"][..., 1].eq(1).all()
    env.assignment = "random"
    tracks = ConeTrackEnv(rings, 8).reset()["info", "track"]
    env.generator.set_state(before)
    assert torch.equal(env.reset()["info", "track"], tracks)


@pytest.mark.slow
def test_restored_env_continues_bit_for_bit(rings):
    env = DrivingTasksEnv(rings, 16, tasks=TASKS, duration=0.5, seed=3)
    _, carrier = drive(env, 20)
    saved = copy.deepcopy(env.state_dict())
    expected, _ = drive(env, 80, carrier.clone())
    assert any(step["done"].any() for step in expected)
    restored = DrivingTasksEnv(rings, 16, tasks=TASKS, duration=0.5, seed=99)
    restored.load_state_dict(saved)
    assert same(drive(restored, 80, carrier.clone())[0], expected)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"tasks": {}}, "tasks is empty; give at least one"),
        ({"tasks": {"fast": {"speed": 1.0}}}, r"tasks.fast has no weight \['speed'\]"),
        ({"tasks": {"fast": {"second": math.nan}}}, "tasks.fast.second=nan must be between"),
        ({"reward": {"speed": 1.0}}, r"reward has no weight \['speed'\]"),
        ({"only": "right"}, "only='right' must be one of centred, corners, left, smooth"),
        ({"duration": 0.01}, "duration=0.01 must be at least one step"),
        ({"rate": 0}, "rate=0 must be more than 0"),
    ],
)
def test_invalid_arguments_are_rejected(rings, wrong, message):
    with pytest.raises(ValueError, match=message):
        DrivingTasksEnv(rings, 2, **({"tasks": TASKS} | wrong))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_tasks_agree_on_a_gpu(rings):
    options = {"tasks": TASKS, "duration": 0.2}
    cpu, gpu = (DrivingTasksEnv(rings, 32, **options, device=device) for device in ("cpu", "cuda"))
    check_env(gpu)
    for env in (cpu, gpu):
        env.set_seed(5)
        env.reset()
    for _ in range(20):
        cpu.task, gpu.task = cpu._next_task(), gpu._next_task()
        assert torch.equal(cpu.task, gpu.task.cpu())
