"""The spline guide with a memory, compared with the oracle and with the authors' program."""

import numpy as np
import pytest
import torch
from oracle import OneCar, RememberingGuide
from torchrl.envs import TransformedEnv
from worlds import AUTHORS

from coil_rl.envs import ConeTrackEnv, random_tracks
from coil_rl.guides import FollowAdvice, SplineMemoryGuide
from coil_rl.testing import check_guide
from coil_rl.transforms import GuideActions

ODD = {"oddities": True, "sight": AUTHORS["sight"], "gain": 80 / 120}
both_guides = pytest.mark.parametrize(
    ("world", "options"), [({}, {}), (AUTHORS, ODD)], ids=["default", "authors"]
)
# Reward, lap time in s and smoothness of the authors' program with its guide
# (shared/tracks/README.md).
RECORDED = [(835.4, 69.58, 0.088), (776.7, 63.55, 0.103), (536.1, 41.13, 0.107)]


def guided(tracks, cars, world, options):
    env = ConeTrackEnv(tracks, cars, assignment="cyclic", **world)
    return TransformedEnv(env, GuideActions({"memory": SplineMemoryGuide(**options)})).eval()


@pytest.mark.slow
@both_guides
def test_guide_agrees_with_the_oracle(world, options):
    tracks, steps = random_tracks(2, seed=5), 180
    env = guided(tracks, 2, world, options)
    cars = [OneCar(track.left, track.right, track.start, **world) for track in tracks]
    guides = [RememberingGuide((track.left, track.right), **options) for track in tracks]
    rng, noise, off = np.random.default_rng(0), np.zeros(2), []
    with torch.no_grad():
        state = env.reset()
        for _ in range(steps):
            advice = state["guide_action"][:, 0, 0].numpy()
            expected = [
                guide.act(car.pose.copy(), car.visible, car.steering)
                for guide, car in zip(guides, cars, strict=True)
            ]
            off += list(np.abs(advice - expected))
            # The noise is large enough to leave the path, not to crash.
            noise = np.clip(0.9 * noise + 0.05 * rng.standard_normal(2), -0.3, 0.3)
            state["action"] = torch.tensor(np.clip(expected + noise, -1, 1)).float().unsqueeze(-1)
            for car, action in zip(cars, state["action"], strict=True):
                car.step(action.item())
            state = env.step(state)
            assert not state["next", "done"].any()
            state = env.step_mdp(state)
    # In single precision nearly coincident midpoints move a target by millimetres, and a choice may
    # come a step later.
    assert np.mean(np.array(off) < 1e-2) > 0.99
    counts = state["guide_state", "memory", "path_target_count"].flatten().tolist()
    assert counts == [len(guide.targets) for guide in guides]
    assert min(counts) >= 8


@pytest.mark.slow
@both_guides
def test_guide_contract_holds(rings, world, options):
    env = ConeTrackEnv(rings, 5, **world)
    check_guide(SplineMemoryGuide(**options), env, steps=30)


@pytest.mark.slow
@both_guides
def test_rows_that_need_nothing_may_be_computed_too(rings, world, options, monkeypatch):
    def drive():
        env = guided(rings, 5, world, options)
        return env.rollout(40, FollowAdvice(env), break_when_any_done=False)

    chosen = drive()
    for module in ("coil_rl.cones.spline_memory", "coil_rl.envs.boundaries"):
        # As on a GPU, where reading the mask would cost more.
        monkeypatch.setattr(f"{module}.rows_in_use", lambda mask: torch.arange(len(mask)))
    assert (drive() == chosen).all()
    assert chosen["guide_state", "memory", "path_target_count"][:, -1].min() > 2


@pytest.mark.slow
def test_guide_knows_its_way_from_motion_alone():
    tracks = random_tracks(2, seed=3)
    env = guided(tracks, 2, {}, {})
    start = torch.tensor([track.start for track in tracks])
    with torch.no_grad():
        state = env.rollout(100, FollowAdvice(env), break_when_any_done=False)["next"][:, -1]
    x, y, turned = state["guide_state", "memory", "path_pose"].double().unbind(-1)
    cos, sin = start[:, 2].cos(), start[:, 2].sin()
    place = torch.stack(
        [start[:, 0] + cos * x - sin * y, start[:, 1] + sin * x + cos * y, start[:, 2] + turned], -1
    )
    assert torch.allclose(place, state["info", "pose"].double(), atol=1e-3)


@pytest.mark.parametrize(("options", "kept"), [({}, 1.0), (ODD, 0.0)], ids=["default", "authors"])
def test_without_a_target_the_steering_is_kept_or_zero(rings, options, kept):
    env = guided(rings, 3, {"sight": 0.5}, options)  # which sees no cone
    state = env.reset()
    for steering in (0.25, -0.5, 0.125):
        state["action"] = torch.full((3, 1), steering)
        state = env.step_mdp(env.step(state))
        assert state["guide_action"].flatten().tolist() == [kept * steering] * 3


@pytest.mark.slow
def test_authors_preset_and_guide_earn_what_their_program_earns(levels):
    env, steps = guided(levels, len(levels), AUTHORS, ODD), []
    over = torch.zeros(len(levels), 1, dtype=torch.bool)
    with torch.no_grad():
        state = env.reset()
        while not over.all():
            state["action"] = state["guide_action"][:, 0]
            after = env.step(state)["next"]
            info = after["info"]
            row = torch.cat(
                [after["reward"], info["lap_time"], info["smoothness"], info["crashed"].float()], -1
            )
            steps.append(row.masked_fill(over, torch.nan))
            over |= after["done"]
            state = env.step_mdp(state)
    for drive, (reward, lap_time, smoothness) in zip(torch.stack(steps, 1), RECORDED, strict=True):
        rewards, laps, roughness, crashed = drive[~drive.isnan().any(-1)].double().unbind(-1)
        assert not crashed.any()
        assert rewards.sum().item() == pytest.approx(reward, rel=0.01)
        assert laps[laps > 0].tolist() == pytest.approx([lap_time, lap_time], abs=0.1)
        assert roughness.mean().item() == pytest.approx(smoothness, abs=0.005)
