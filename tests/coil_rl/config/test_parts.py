"""The parts of a configuration are those that it describes, and its proxies are trained once."""

import shutil
from itertools import product
from pathlib import Path

import pytest
import torch
from odd_parts import Gain
from omegaconf import OmegaConf
from programs import ONE_SECOND, composed, shipped
from torchrl.envs import RenameTransform, Transform, TransformedEnv

from coil_rl.config import parts
from coil_rl.config.assemble import load_guides
from coil_rl.config.check import check
from coil_rl.config.nodes import build
from coil_rl.config.parts import (
    PROXIES,
    build_bare_env,
    build_guides,
    build_learner,
    build_transforms,
    cases_node,
    copy_proxies,
    disturbances,
    env_maker,
    frames_of,
    guides_with_untrained_proxies,
    proxy_config,
    trains_guides,
    unread_controllers,
)
from coil_rl.config.python import Named, named, open_run
from coil_rl.config.python import composed as composed_in_python
from coil_rl.envs.reward import RewardWeights
from coil_rl.errors import UserError
from coil_rl.guides import RandomGuide
from coil_rl.programs.distill import distill
from coil_rl.programs.train import train
from coil_rl.record import METRICS
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.run.parts import TEST, TESTS, TRAIN
from coil_rl.testing import check_env, check_guide
from coil_rl.transforms import ActionDelay, GuideActions, ObservationDelay

SMALL = [
    "track=generated",
    "track.train.count=1",
    "track.test.count=1",
    "budget.num_envs=4",
    "run_dir=unused",
]


def small(*overrides):
    return composed(*SMALL, *overrides)


@pytest.mark.fast(1)
@pytest.mark.parametrize(("method", "preset"), [*product(shipped("method"), shipped("preset"))])
def test_env_of_every_method_passes_check_env(method, preset):
    env = env_maker(small(f"preset={preset}", f"method={method}"))()
    check_env(env, steps=3)
    assert env.rate == {"default": 12, "paper": 24, "authors": 60}[preset]


# They need a package, a class, an entry, a run, an entry to control, a file or recordings.
NOT_ALONE = {"cone_planner", "controller", "entry", "exported", "learned", "pid", "recorded"}
NOT_ALONE |= {"recording", "none"}
OF_OTHER_ENVS = {"bot", "energy_pump", "lander", "linear_feedback", "oscillator", "swing_tip"}
OF_OTHER_ENVS |= {"swing_up", "walker"}


@pytest.mark.fast(3)
@pytest.mark.parametrize("guide", sorted({*shipped("guide")} - NOT_ALONE - OF_OTHER_ENVS))
def test_every_guide_acts_on_the_observations_of_the_env(guide):
    config = small(f"guide={guide}")
    (guide_module,), env = build_guides(config).values(), build_bare_env(config)
    advised = TransformedEnv(env, GuideActions({guide: guide_module}))
    assert advised.reset()["guide_action"].shape == (4, 1, 1)
    if guide != "random":
        check_guide(guide_module, env)


def test_override_with_another_target_replaces_all_arguments():
    config = small("env=simulated_robot")
    tracks = {"_target_": "coil_rl.envs.robot_tracks", "scale": 1.0}
    env = build_bare_env(config, {"tracks": tracks, "reward": {"finish": 1.0}, "num_envs": 2})
    assert (env.batch_size, config.budget.num_envs) == ((2,), 4)
    assert [track.name for track in env.tracks] == ["robot (simulated)"]
    weights = RewardWeights(*env.weights)
    assert (weights.finish, weights.crash) == (1, -100)


class Halves(Transform):
    """Halves the reward, and does not say that it writes it."""

    def _step(self, tensordict, next_tensordict):
        return next_tensordict.set("reward", next_tensordict["reward"] / 2)


@pytest.mark.parametrize(
    "node",
    [
        "{_target_: torchrl.envs.RewardScaling, loc: 0, scale: 0.5}",
        "{_target_: torchrl.envs.RewardClipping, clamp_min: -0.01, clamp_max: 0.01}",
        f"{{_target_: {__name__}.Halves}}",
    ],
)
def test_returns_are_the_envs_own_whatever_a_method_makes_of_its_rewards(node):
    results = []
    for words in ([], [f"+method.transforms.own={node}"]):
        env = env_maker(small("method=ppo", *words))(cases=TEST)
        results.append(evaluate_policy(env, RandomGuide(-1, 1)).rewards)
    assert results[0] == results[1]
    after = env.rollout(5)["next"]
    assert not torch.equal(after["reward"], after["task_reward"])


def test_transform_that_takes_steps_itself_is_refused():
    node = "{_target_: torchrl.envs.FrameSkipTransform, frame_skip: 2}"
    with pytest.raises(UserError, match="FrameSkipTransform takes steps that are not counted"):
        env_maker(small("method=ppo", f"+method.transforms.own={node}"))()


def lists_its_arguments(**options):
    raise TypeError(f"unexpected {options}")


@pytest.mark.slow
def test_long_message_of_a_part_is_cut():
    node = {"_target_": f"{__name__}.lists_its_arguments", "numbers": list(range(9999))}
    with pytest.raises(
        UserError, match=r"^env: unexpected {'numbers': \[0, 1, 2,[ 0-9,]{300,500} \.\.\.$"
    ):
        build(node, "env")


def test_guide_drives_with_degraded_advice():
    config = small("guide=constant", "guide.constant.value=0.4", "degrade=[undertuned,biased]")
    env, policy = env_maker(config).guided(4, TRAIN)
    step = env.step(policy(env.reset()))
    torch.testing.assert_close(step["next", "steering"], torch.full((4, 1), 0.4 * 0.5 + 0.2))


def test_advice_of_a_method_without_any_is_not_degraded():
    view = "{_target_: coil_rl.transforms.ObservationNoise, sigma: 0.1, seed: 0}"
    config = small(
        "method=ppo", f"+method.transforms.view={view}", "degrade=[random]", "run_dir=unused"
    )
    transforms = build_transforms(config)
    assert [type(part).__name__ for part in transforms] == ["ObservationNoise"]
    env_maker(config)().rollout(2)


def test_advice_is_degraded_after_the_transforms_of_the_method():
    config = small(
        "method=residual", "guide=constant", "guide.constant.value=0.4", "degrade=[zeroed]"
    )
    env = env_maker(config)()
    step = env.step(env.reset().set("action", torch.full((4, 1), 0.5)))
    torch.testing.assert_close(step["next", "steering"], torch.full((4, 1), 0.25))


@pytest.mark.fast(2)
@pytest.mark.parametrize("learner", shipped("learner"))
def test_every_learner_is_built(learner):
    config = small(f"learner={learner}")
    env = env_maker(config)()
    built = build_learner(
        config, env, guides_with_untrained_proxies(config) if trains_guides(config) else None
    )
    assert built.policy(env.reset())["action"].shape == env.action_spec.shape


@pytest.mark.slow
@pytest.mark.parametrize("track", sorted({*shipped("track")} - {"folder"}))
def test_every_track_group_has_tracks(track):
    node = composed(f"track={track}", "run_dir=unused").track
    fewest = 1 if track == "robot" else 3
    assert min(len(build(node.train, "track.train")), len(build(node.test, "track.test"))) >= fewest


@pytest.mark.parametrize(
    ("env", "key"), [("cone_track", "starts"), ("simulated_robot", "starts"), ("pendulum", "cases")]
)
def test_cases_of_several_drivers_are_the_same_ones(env, key):
    evaluation = composed(f"env={env}", "run_dir=unused").evaluation
    # In the file of a run all references are resolved.
    stored = OmegaConf.create({"evaluation": OmegaConf.to_container(evaluation, resolve=True)})
    node = cases_node(stored, 6, "selection", 3)
    assert (node[key], node["num_envs"]) == (3, 6)


def test_disturbances_hold_in_training_and_evaluation_unless_one_of_them_has_its_own():
    both = small("disturb=[observation_delay]")
    assert disturbances(both, TRAIN) == disturbances(both, TEST)
    longer = small(
        "disturb=[observation_delay,action_delay]",
        "+evaluation.disturb.observation_delay.max_lag=7",
        "+training.disturb.action_delay=null",
    )
    lags = {
        cases: {name: node["max_lag"] for name, node in disturbances(longer, cases).items()}
        for cases in (TRAIN, TESTS, TEST, "evaluation")
    }
    assert lags[TRAIN] == lags[TESTS] == {"observation_delay": 2}
    assert lags[TEST] == lags["evaluation"] == {"observation_delay": 7, "action_delay": 2}


def test_disturbances_come_before_the_guides_and_only_in_the_own_env_of_a_run():
    config = small("disturb=[observation_delay,action_delay]", "method=coil")
    make_env = env_maker(config)
    for env in (make_env(), make_env.guided(2, TEST)[0]):
        kinds = [type(part) for part in env.transform]
        assert kinds.index(ObservationDelay) < kinds.index(ActionDelay) < kinds.index(GuideActions)
    around = make_env.around(build_bare_env(config))
    assert ObservationDelay not in [type(part) for part in around.transform]


def test_the_authors_observe_late_in_their_world_and_nowhere_else():
    assert disturbances(small("preset=authors"), TRAIN)["late"]["min_lag"] == 1
    assert not disturbances(small("env=simulated_robot", "preset=authors"), TRAIN)


def test_the_view_of_the_agent_alone_is_late_behind_the_guides():
    config = small("+disturb@method.transforms.view=observation_delay", "method=coil")
    kinds = [type(part) for part in env_maker(config)().transform]
    assert kinds.index(GuideActions) < kinds.index(ObservationDelay)


def push(env, observation):
    """Push a cart where its pole leans to."""
    return int(observation[2] > 0)


BESIDE = [
    "env=cart_pole",
    *(
        f"+env.controllers.{name}={{_target_: {__name__}.push, _partial_: true}}"
        for name in ("leaning", "other")
    ),
    "guide=entry",
    "guide.entry.key=[controller,leaning]",
    "run_dir=unused",
]


def composed_beside(*overrides):
    return composed(*BESIDE, *overrides)


def beside(env):
    return list(env.base_env.held.plants[0].controllers)


@pytest.mark.parametrize(
    ("words", "read"),
    [
        ("method=ppo", []),
        ("method=ppo label=others observes=[observation,leaning_more]", []),  # in other words
        *((f"method={method}", ["leaning"]) for method in ("coil", "coil_rfc", "kickstart")),
        ("method=ppo observes=[observation,[controller,other]]", ["other"]),
        ("method=ppo +watch.step.other=[controller,other]", ["other"]),
        ("method=ppo evaluation.measures.completed.entry=[controller,other]", ["other"]),
    ],
)
def test_controllers_that_nothing_reads_are_known(words, read):
    unread = unread_controllers(composed_beside(*words.split()))
    assert unread == {"leaning", "other"} - {*read}


def test_env_has_the_controllers_that_are_read():
    assert beside(env_maker(composed_beside("method=ppo"))(2)) == []
    assert beside(env_maker(composed_beside("method=coil"))(2)) == ["leaning"]
    alone, _ = env_maker(composed_beside("method=ppo")).guided(2, TEST)
    assert "leaning" in beside(alone)


def test_controller_that_a_transform_reads_stays(monkeypatch):
    transform = RenameTransform([("controller", "leaning")], ["leaning"])
    monkeypatch.setattr(parts, "build_transforms", lambda *_: [transform])
    assert unread_controllers(composed_beside("method=ppo")) == {"other"}


TINY = [
    *ONE_SECOND,
    "proxy.budget.frames=256",
    "proxy.budget.num_envs=4",
    "proxy.budget.steps=16",
    "proxy.learner.regressor.epochs=20",
]


def composed_of_proxy(*overrides, name="train"):
    return composed(*TINY, *overrides, name=name)


@pytest.fixture(scope="module")
def proxies(tmp_path_factory):
    folder = tmp_path_factory.mktemp("distill")
    words = ["guide=[spline,constant]", f"proxy.folder={folder / 'proxies'}", f"run_dir={folder}"]
    config = composed_of_proxy(*words, name="distill")
    distill(config)
    return folder / "proxies"


@pytest.mark.slow
def test_folder_of_a_proxy_follows_from_guide_env_and_settings():
    def folder(*overrides, guide="spline"):
        config = composed_of_proxy("guide=[spline,constant]", "run_dir=unused", *overrides)
        return Path(proxy_config(config, guide).run_dir)

    assert folder() == folder("seed=3", "method=ppo", "budget.frames=64", "run_dir=other")
    assert folder().parent == Path("outputs/proxies")
    others = [
        folder(other)
        for other in ("guide.spline.gain=0.9", "env.rate=20", "proxy.seed=1", "track.train.seed=5")
    ]
    assert len({folder(), folder(guide="constant"), *others}) == 6


@pytest.mark.slow
def test_proxy_is_trained_behind_the_delays_and_noise_of_the_run():
    def proxy(*overrides):
        config = composed_of_proxy("guide=spline", "run_dir=unused", *overrides)
        return proxy_config(config, "spline")

    words = ["disturb=[observation_delay]", "+evaluation.disturb.observation_delay.max_lag=7"]
    disturbed = proxy(*words)
    kinds = [type(part) for part in env_maker(disturbed)().transform]
    assert kinds.index(ObservationDelay) < kinds.index(GuideActions)
    lags = [
        disturbances(disturbed, cases)["observation_delay"]["max_lag"] for cases in (TRAIN, TEST)
    ]
    assert lags == [2, 7]
    others = [
        proxy(),
        proxy(words[0]),
        proxy(*words, "disturb.observation_delay.min_lag=1"),
        proxy(*words, "+training.disturb.observation_delay=null"),
    ]
    assert disturbed.run_dir == proxy(*words, "seed=3").run_dir
    assert len({disturbed.run_dir, *(other.run_dir for other in others)}) == 5


def folder_of_proxy(guide):
    given = named("Pendulum-v1", guide, "place")
    words = [*given.words, "method=dynamic_coil_sequential"]
    config = composed_in_python(Named(words, given.nodes), "unused").config
    return proxy_config(config, next(iter(config.guide))).run_dir


def test_proxies_of_other_objects_are_other_ones():
    one, other = (Gain(gain) for gain in (1.0, 2.0))
    assert folder_of_proxy(one) == folder_of_proxy(Gain(1.0)) != folder_of_proxy(other)


def test_proxies_of_other_code_are_other_ones(monkeypatch):
    before = folder_of_proxy("random")
    monkeypatch.setattr(parts, "code_of_run", lambda config: {"mine": "a hash of its file"})
    assert folder_of_proxy("random") != before


def distilled(folder):
    """Make the proxy of a constant guide, or find it."""
    words = ["guide=constant", f"proxy.folder={folder}", f"run_dir={folder.parent}"]
    distill(composed_of_proxy(*words, name="distill"))


@pytest.mark.slow
def test_distilling_reports_the_error_of_the_network_and_reuses_it(proxies, capsys):
    folder = next(proxies.glob("constant_*"))
    last = METRICS.read(folder)[-1]
    assert last["learner/mse_training"] < 0.01
    assert last["learner/mse_ahead"] < 0.01
    distilled(proxies)
    output = capsys.readouterr().out
    assert str(folder) in output
    assert "distill: made 0, found 1; the lowest mean reward is" in output


@pytest.mark.slow
def test_proxy_that_was_killed_goes_on_to_the_same_weights(proxies, tmp_path, capsys):
    whole = next(proxies.glob("constant_*"))
    stopped = tmp_path / whole.name
    stopped.mkdir()
    # Before the first checkpoint.
    for name in ("config.yaml", "versions.json", "guide_return.json"):
        shutil.copy(whole / name, stopped)
    distilled(tmp_path)
    assert "distill: made 1, found 0;" in capsys.readouterr().out
    resumed = torch.load(stopped / "policy_last.pt", weights_only=True)
    for key, value in torch.load(whole / "policy_last.pt", weights_only=True).items():
        assert torch.equal(resumed[key], value), key


@pytest.mark.parametrize(("asked", "taken"), [(1, 64), (64, 64), (65, 128)])
def test_frames_of_a_proxy_are_whole_batches(asked, taken):
    words = ["guide=spline", "method=dynamic_coil_sequential", f"proxy.budget.frames={asked}"]
    proxy = proxy_config(composed_of_proxy(*words, "run_dir=unused"), "spline")
    assert frames_of(proxy.budget) == taken


@pytest.mark.slow
def test_run_trains_missing_proxies_and_copies_all_of_them(proxies, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    overrides = [
        *("method=dynamic_coil_sequential", "guide=[spline,zero]", f"proxy.folder={proxies}"),
        *("budget.frames=576", "learner.epochs=1", "learner.minibatches=2", f"run_dir={run}"),
    ]
    with pytest.raises(UserError, match="as the proxies of its guides take 512 frames"):
        check(composed_of_proxy(*overrides, "budget.frames=512"))
    config = composed_of_proxy(*overrides)
    check(config)
    train(config)
    assert sorted(path.name for path in (run / "proxies").iterdir()) == ["spline", "zero"]
    assert len(list(proxies.glob("zero_*"))) == 1
    used = [next(proxies.glob(f"{name}_*")) for name in ("spline", "zero")]
    assert METRICS.read(run)[0]["frames/before"] == sum(
        METRICS.read(folder)[-1]["frames"] for folder in used
    )
    network = load_guides(run, config)["spline"]
    state = torch.load(used[0] / "policy_last.pt", weights_only=True)
    assert all(torch.equal(value, state[key]) for key, value in network.state_dict().items())
    assert open_run(run).policy()[0].names == ["spline", "zero"]


def test_proxies_are_copied_whole_or_not_at_all(tmp_path):
    run, folder = tmp_path / "run", tmp_path / "folder"
    for made in (run, folder):
        made.mkdir()
    (folder / PROXIES).write_text("a file in their place")
    with pytest.raises(UserError, match="proxies is a file, but a folder is to be made there"):
        copy_proxies({"guide": run}, folder)
    (folder / PROXIES).unlink()
    with pytest.raises(FileNotFoundError):
        copy_proxies({"guide": run}, folder)
    assert not list(folder.iterdir())


def test_network_with_a_memory_has_its_transforms_in_an_env():
    words = ["env=pendulum", "method=ppo", "learner=ppo", "network=gru", "learner.minibatches=1"]
    env = parts.env_maker(composed(*words))(2)
    assert "is_init" in env.reset()
