import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.envs import RewardSum, TransformedEnv
from worlds import driving_measures, perturbed

from coil_rl import GymnasiumEnv
from coil_rl.envs import ConeTrackEnv
from coil_rl.guides import ConstantGuide, SplineGuide
from coil_rl.learners import PPO
from coil_rl.run.curve import EvaluationCurve, measures
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.run.metrics import Metrics
from coil_rl.run.parts import EnvMaker
from coil_rl.transforms import GuideActions

CASES = 5
WATCH = {
    "episode": {"crashed": ["info", "crashed"]},
    "step": {"smoothness": ["info", "smoothness"]},
}


def maker(tracks):
    options = {"starts": CASES, "assignment": "cyclic", "rate": 6, "time_limit": 4}
    return EnvMaker(
        lambda rows, cases, count: ConeTrackEnv(tracks, rows, **options),
        transforms=lambda advice: [GuideActions({"spline": SplineGuide()})],
        sizes=dict.fromkeys(("evaluation", "selection"), CASES),
    )


def world(tracks):
    return maker(tracks)(CASES)


def curve(folder, tracks, policy, stages=(1,), **options):
    make_env = maker(tracks)
    line = EvaluationCurve(folder, policy, make_env, make_env.sizes, watch=WATCH, **options)
    line.attach(Metrics(folder / "metrics.csv"), stages, frames=100, before=28)
    return line


def test_driver_that_never_changes_gives_a_flat_line(tmp_path, rings):
    line = curve(tmp_path, rings, PPO(world(rings)).policy)
    for update in (0, 1, 2):
        line.keep(update)
    assert (tmp_path / "policies" / "000000000228.pt").exists(), "28 frames before the first update"
    rows = line.evaluate([0, 1, 2])
    assert list(rows[0]) == line.columns
    assert rows[0] == rows[1] == rows[2]
    assert rows[0]["evaluation/return"] == rows[0]["selection/return"]


def test_numbers_are_those_of_each_policy_driven_alone(tmp_path, rings):
    policy = PPO(world(rings)).policy
    line = curve(tmp_path, rings, policy)
    expected = []
    for update in (0, 1):
        policy.load_state_dict(perturbed(policy, seed=update))
        line.keep(update)
        expected.append(evaluate_policy(world(rings), policy, measures=driving_measures()).episodes)
    assert expected[0] != expected[1]
    for row, episodes in zip(line.evaluate([0, 1]), expected, strict=True):
        for name in ("return", "crashed", "smoothness"):
            key = "reward" if name == "return" else name
            mean = sum(episode[key] for episode in episodes) / CASES
            assert row[f"evaluation/{name}"] == pytest.approx(mean, rel=1e-4, abs=1e-5)


def test_driving_leaves_the_random_numbers_alone(tmp_path, rings):
    line = curve(tmp_path, rings, PPO(world(rings)).policy)
    line.keep(0)
    before = torch.get_rng_state()
    line.evaluate([0])
    assert torch.equal(torch.get_rng_state(), before)


def test_kept_policies_are_spread_over_the_run_and_each_is_driven_once(tmp_path, rings):
    policy = PPO(world(rings)).policy
    for updates, points, batches in [(49, 16, 1), (49, 16, 3), (3, 16, 1), (1, 1, 4), (100, 7, 7)]:
        line = curve(tmp_path, rings, policy, [updates], points=points, batches=batches)
        kept = line.kept()
        assert (kept[0], kept[-1], len(kept)) == (0, updates, min(points, updates) + 1)
        driven = [line.batch(update) for update in range(updates + 1)]
        assert [update for batch in driven for update in batch] == kept
        assert sum(map(bool, driven)) == min(batches, updates)


def test_run_that_was_made_longer_keeps_policies_as_before_and_evenly_until_its_new_end(
    tmp_path, rings
):
    policy = PPO(world(rings)).policy
    line = curve(tmp_path, rings, policy, [8, 16, 40], points=4, batches=2)
    assert line.kept() == [0, 2, 4, 6, 8, 10, 12, 14, 16, 22, 28, 34, 40]
    batches = [line.batch(update) for update in range(41)]
    evaluated = [[0, 2, 4], [6, 8], [10, 12], [14, 16], [22, 28], [34, 40]]
    assert [batch for batch in batches if batch] == evaluated
    assert all(line.batch(batch[-1]) == batch for batch in evaluated)


def test_guide_measured_from_its_cases_does_not_crash(rings):
    values = measures(world(rings), SplineGuide(), watch=WATCH)
    assert [*values] == ["return", "crashed", "smoothness"]
    assert all(value.shape == (CASES,) for value in values.values())
    assert not values["crashed"].any()


@pytest.mark.slow
def test_returns_are_summed_as_exactly_as_those_of_the_table():
    class Costly(gymnasium.Env):
        observation_space, action_space = spaces.Box(-1, 1, (1,)), spaces.Box(-1, 1, (1,))

        def reset(self, *, seed=None, options=None):
            return np.zeros(1, np.float32), {}

        def step(self, action):
            reward = -1000.0 - 0.05 * float((action[0] - 0.5) ** 2)
            return np.zeros(1, np.float32), reward, False, False, {}

    env = TransformedEnv(GymnasiumEnv(Costly, num_envs=2, max_steps=1000), RewardSum())
    for action in (0.5, 0.0):
        guide = ConstantGuide(action)
        expected = evaluate_policy(env, guide).episodes[0]["reward"]
        assert measures(env, guide)["return"].tolist() == [expected] * 2
        assert expected == pytest.approx(-1e6 - 50 * (action - 0.5) ** 2, abs=0.1)
