import copy
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from worlds import AUTHORS, driving_measures

from coil_rl.compiled import Compiled
from coil_rl.cones.spline import SplineGuide
from coil_rl.envs import ConeTrackEnv, random_tracks, shipped_tracks
from coil_rl.envs.reward import TERMS
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.testing import check_env
from coil_rl.transforms import GuideActions


@pytest.fixture(scope="module")
def tracks():
    return random_tracks(3, seed=1)


def steering(steps, cars, seed):
    """Smooth random actions [steps, cars, 1], small for the first cars and large for the last."""
    draw = torch.Generator().manual_seed(seed)
    actions = [torch.zeros(cars, 1)]
    for _ in range(steps):
        push = torch.linspace(0.01, 0.3, cars).unsqueeze(-1) * torch.randn(cars, 1, generator=draw)
        actions.append((0.95 * actions[-1] + push).clamp(-1, 1))
    return torch.stack(actions[1:])


def advance(env, state, action):
    """Step and reset finished cars; return the output of the step and the next state."""
    state["action"] = action.to(env.dtype_)
    emitted, state = env.step_and_maybe_reset(state)
    return emitted["next"], state


def drive(env, actions):
    """Return the outputs of all steps, with resets."""
    state, outputs = env.reset(), []
    for action in actions:
        emitted, state = advance(env, state, action.to(env.device))
        outputs.append(emitted)
    return outputs


def buffers(env):
    state = env.state_dict().items()
    return {name: value.clone() for name, value in state if not name.endswith("_extra_state")}


@pytest.mark.fast(3)
@pytest.mark.parametrize(
    "options", [{}, {"assignment": "cyclic"}, {"dtype": torch.float64}, {"info": False}, AUTHORS]
)
def test_env_contract_holds(rings, options):
    check_env(ConeTrackEnv(rings, 3, **options))


@pytest.mark.slow
def test_env_is_batch_invariant(tracks):
    cars, chosen = 384, (150, 381)
    env = ConeTrackEnv(tracks, cars, assignment="cyclic")
    actions = steering(150, cars, seed=3)
    state = env.reset()
    for action in actions[:50]:
        _, state = advance(env, state, action)
    # A new env of one car is on the first track, like the chosen cars of the batch.
    alone = {car: ConeTrackEnv(tracks, 1, assignment="cyclic") for car in chosen}
    states = {}
    for car, single in alone.items():
        single.reset()
        columns = {name: value[..., car : car + 1] for name, value in buffers(env).items()}
        single.load_state_dict(env.state_dict() | columns)
        states[car] = state[car : car + 1].clone()
    resets = 0
    for action in actions[50:]:
        emitted, state = advance(env, state, action)
        resets += int(emitted["done"].sum())
        for car, single in alone.items():
            own, states[car] = advance(single, states[car], action[car : car + 1])
            assert (own == emitted[car : car + 1]).all()
    assert resets > cars / 2
    for car, single in alone.items():
        for name, value in buffers(single).items():
            assert torch.equal(value, buffers(env)[name][..., car : car + 1])


def test_info_does_not_change_the_other_outputs(tracks):
    full, bare = (ConeTrackEnv(tracks, 8, info=info, seed=3) for info in (True, False))
    actions = steering(60, 8, seed=3)
    for with_info, without in zip(drive(full, actions), drive(bare, actions), strict=True):
        assert "info" not in without
        assert (with_info.exclude("info") == without).all()


@pytest.mark.parametrize("assignment", ["random", "cyclic"])
def test_partial_reset_changes_only_the_masked_cars(rings, assignment):
    env = ConeTrackEnv(rings, 12, assignment=assignment)
    state = env.reset()
    for action in steering(20, 12, seed=4):
        state["action"] = action
        state = env.step_mdp(env.step(state))
    before = buffers(env)
    mask = torch.arange(12) % 3 == 1
    fresh = env.reset(TensorDict({"_reset": mask.unsqueeze(-1)}, 12))
    after = buffers(env)
    for name, value in before.items():
        assert torch.equal(after[name][..., ~mask], value[..., ~mask]), name
    assert torch.equal(env.pose[:, mask], env.start_pose[:, env.track[mask]])
    for name in ("history", "steps", "lap", "in_finish"):
        assert not after[name][..., mask].any(), name
    assert fresh["observation"][mask].ne(state["observation"][mask]).any(dim=-1).all()


def drawn_tracks(env):
    return torch.cat([env.reset()["info", "track"] for _ in range(5)])


def test_seed_determines_the_tracks_without_the_global_random_state(rings):
    torch.manual_seed(1)
    tracks = drawn_tracks(ConeTrackEnv(rings, 20, seed=7))
    torch.manual_seed(2)
    state = torch.get_rng_state()
    assert torch.equal(drawn_tracks(ConeTrackEnv(rings, 20, seed=7)), tracks)
    assert torch.equal(torch.get_rng_state(), state)
    assert not torch.equal(drawn_tracks(ConeTrackEnv(rings, 20, seed=8)), tracks)
    assert tracks.unique().tolist() == [0, 1, 2]
    env = ConeTrackEnv(rings, 20, seed=8)
    env.set_seed(7)
    assert torch.equal(drawn_tracks(env), tracks)


def test_cyclic_assignment_keeps_cars_on_their_tracks(rings):
    env = ConeTrackEnv(rings, 7, assignment="cyclic")
    for _ in range(3):
        assert env.reset()["info", "track"].flatten().tolist() == [0, 1, 2, 0, 1, 2, 0]


@pytest.mark.slow
@pytest.mark.parametrize("preset", [{}, AUTHORS], ids=["paper", "authors"])
def test_restored_env_continues_bit_for_bit(tracks, preset):
    env = ConeTrackEnv(tracks, 16, seed=3, **preset)
    actions = steering(220, 16, seed=6)
    state = env.reset()
    for action in actions[:60]:
        _, state = advance(env, state, action)
    saved, saved_state = copy.deepcopy(env.state_dict()), state.clone()
    trace = []
    for action in actions[60:]:
        emitted, state = advance(env, state, action)
        trace.append((emitted, state.clone()))
    # The draws of future tracks are part of the state, so some episodes have to end.
    assert sum(int(emitted["done"].sum()) for emitted, _ in trace) > 10

    restored = ConeTrackEnv(tracks, 16, seed=99, **preset)
    restored.load_state_dict(saved)
    for action, (emitted, after) in zip(actions[60:], trace, strict=True):
        ours, saved_state = advance(restored, saved_state, action)
        assert (ours == emitted).all()
        assert (saved_state == after).all()


def test_time_limit_truncates(rings):
    env = ConeTrackEnv(rings, 4, time_limit=0.5)
    rollout = env.rollout(20, SplineGuide(), break_when_any_done=True)["next"]
    assert rollout.shape == (4, 12)
    assert rollout["truncated"][:, -1].all()
    assert rollout["done"][:, -1].all()
    assert not rollout["truncated"][:, :-1].any()
    assert not rollout["terminated"].any()


@pytest.mark.slow
def test_reward_is_the_sum_of_its_weighted_terms(ring):
    weights = {"finish": 3.0, "second": -0.1, "cone": 0.5, "smooth": -7.0}
    weights |= {"alive": 0.25, "crash": -9.0}
    env = ConeTrackEnv([ring], 8, rate=8, laps=1, reward=weights)
    guide = SplineGuide()
    state = env.reset()
    finished = 0
    for action in steering(155, 8, seed=8):
        emitted, state = advance(env, state, guide(state)["action"] + 0.2 * action)
        terms, alive = emitted["info", "reward"], ~emitted["info", "crashed"]
        lap_time = emitted["info", "lap_time"]
        total = sum(terms[term] for term in TERMS)
        smooth = -7 * emitted["info", "smoothness"] * alive
        finish = (3 - 0.1 * lap_time) * (lap_time > 0) * alive
        assert torch.allclose(emitted["reward"], total, rtol=0, atol=1e-6)
        assert torch.allclose(terms["smooth"], smooth, rtol=0, atol=1e-6)
        assert torch.allclose(terms["finish"], finish, rtol=0, atol=1e-5)
        assert torch.equal(terms["alive"], 0.25 * alive)
        assert torch.equal(terms["crash"], -9.0 * ~alive)
        finished += int((lap_time > 0).sum())
    assert finished > 0


def test_outputs_are_never_modified_later(tracks):
    env = ConeTrackEnv(tracks, 24)
    state = env.reset()
    kept = [(state, state.clone())]
    for action in steering(80, 24, seed=9):
        before = state.clone()
        emitted, after = advance(env, state, action)
        kept += [(emitted, emitted.clone()), (after, after.clone())]
        assert (state.select(*before.keys()).exclude("action") == before.exclude("action")).all()
        state = after.clone(recurse=False)
    env.reset()
    assert all((data.select(*copied.keys()) == copied).all() for data, copied in kept)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"time_limit": 0.01}, "time_limit=0.01 must be at least one step"),
        ({"reward": {"finish": 1e300}}, "reward.finish=1e[+]300 must be between -1e6 and 1e6"),
        ({"reward": {"speed": 1.0}}, r"reward has no weight \['speed'\]; it has finish, second"),
        ({"smoothing": -0.1}, "smoothing=-0.1 must be"),
        ({"kept_cones": 1}, "kept_cones=1 must be at least 2"),
        ({"tracks": []}, "at least one track"),
    ],
)
def test_invalid_arguments_are_rejected(rings, wrong, message):
    with pytest.raises(ValueError, match=message):
        ConeTrackEnv(**({"tracks": rings, "num_envs": 2} | wrong))


def test_actions_are_clamped(rings):
    wild = torch.tensor([[[5.0], [-3.0], [0.5], [1.0001]], [[-9.0], [2.0], [0.1], [-1.5]]])
    envs = [ConeTrackEnv(rings, 4, assignment="cyclic") for _ in range(2)]
    outputs, clamped = drive(envs[0], wild), drive(envs[1], wild.clamp(-1, 1))
    assert all((ours == theirs).all() for ours, theirs in zip(outputs, clamped, strict=True))


def test_number_of_kept_cones_changes_only_the_padding(rings):
    # On these tracks a car never sees sixteen cones of a side.
    few, many = (ConeTrackEnv(rings, 8, kept_cones=kept, assignment="cyclic") for kept in (16, 30))
    actions = steering(60, 8, seed=12)
    for narrow, wide in zip(drive(few, actions), drive(many, actions), strict=True):
        assert wide["cones"].shape == (8, 2, 30, 2)
        assert torch.equal(wide["cones"][:, :, :16], narrow["cones"])
        assert (narrow.exclude("cones") == wide.exclude("cones")).all()


@pytest.mark.slow
def test_ten_million_random_steps_are_finite_in_constant_memory():
    cars = 16_384
    env = ConeTrackEnv(shipped_tracks("all"), cars)
    draw = torch.Generator().manual_seed(0)
    state, driven, resident = env.reset(), 0, []
    while driven < 10_000_000:
        noise = torch.randn(cars, 1, generator=draw)
        state["action"] = (0.9 * state["steering"] + 0.3 * noise).clamp(-1, 1)
        step, state = env.step_and_maybe_reset(state)
        driven += cars
        if driven // cars % 50 == 0:
            assert step["next"].isfinite().all()
            resident.append(int(Path("/proc/self/statm").read_text().split()[1]) * 4096)
    assert max(resident[len(resident) // 2 :]) < 1.02 * max(resident[: len(resident) // 2])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_env_agrees_on_a_gpu(tracks):
    cpu, gpu = (ConeTrackEnv(tracks, 32, assignment="cyclic", device=on) for on in ("cpu", "cuda"))
    check_env(gpu)
    actions = steering(30, 32, seed=13)
    for ours, theirs in zip(drive(cpu, actions), drive(gpu, actions), strict=True):
        assert theirs.device.type == "cuda"
        assert torch.allclose(ours["observation"], theirs["observation"].cpu(), atol=1e-2)
        assert torch.equal(ours["info", "track"], theirs["info", "track"].cpu())


@pytest.mark.slow
def test_lap_that_begins_anywhere_counts_as_driven_from_the_finish(rings):
    world = {"assignment": "cyclic", "laps": 1, "rate": 12}
    envs = ConeTrackEnv(rings, 3, **world), ConeTrackEnv(rings, 12, starts=12, **world)
    whole, parts = (
        evaluate_policy(env, SplineGuide(), measures=driving_measures()).episodes for env in envs
    )
    for car, part in enumerate(parts):
        assert part["completed"]
        assert part["steps"] < whole[car % 3]["steps"]
        assert part["lap_time"] == pytest.approx(whole[car % 3]["lap_time"], rel=0.04)


def test_staggered_episodes_end_at_different_times(rings):
    env = ConeTrackEnv(rings, 200, starts=30, time_limit=10, rate=6)
    data = env.rollout(60, SplineGuide(), break_when_any_done=False, auto_cast_to_device=False)
    ends = data["next", "truncated"].sum(0).squeeze(-1)
    assert ends.sum() >= 199
    assert ends.max() < 14


@pytest.mark.slow
def test_compiled_steps_are_the_steps(rings, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    plain, compiled = (
        TransformedEnv(ConeTrackEnv(rings, 6), GuideActions({"spline": SplineGuide()}))
        for _ in range(2)
    )
    for module in compiled.modules():
        getattr(module, "compile_steps", lambda _: None)(Compiled)
    ours, theirs = compiled.reset(), plain.reset()
    for count in range(60):
        action = torch.linspace(-1, 1, 6).unsqueeze(-1) * (count / 60)
        step, ours = compiled.step_and_maybe_reset(ours.set("action", action))
        expected, theirs = plain.step_and_maybe_reset(theirs.set("action", action))
        torch.testing.assert_close(step["next"], expected["next"], rtol=1e-3, atol=1e-4)
    for name, value in plain.base_env.state_dict().items():
        found = compiled.base_env.state_dict()[name]
        torch.testing.assert_close(found, value, rtol=1e-3, atol=1e-4)
