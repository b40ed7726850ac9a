"""Whole runs of any method in the cone world, as small as they can be."""

from programs import composed as composed_words
from programs import shipped

from coil_rl.config.check import check
from coil_rl.programs.train import train

METHODS = shipped("method")
TRACKS = ["track=generated", "track.train.count=1", "track.test.count=2"]
TINY = [*TRACKS, "env.laps=1", "env.time_limit=0.5", "env.rate=12", "logger=none"]
TINY += ["evaluation.repeats=1", "evaluation.gif=false", "~evaluation.pictures.lines"]
TINY += ["evaluation.curve.env.time_limit=0.5", "evaluation.curve.num_envs=2"]
TINY += ["checkpoint_every=1", "budget.num_envs=4", "budget.steps=16", "budget.frames=128"]
PPO = ["learner.epochs=2", "learner.minibatches=2"]
SMALL_PROXY = [*PPO, "guide=[zero,constant]", "proxy.learner.regressor.epochs=1"]
SMALL_PROXY += ["proxy.budget.frames=64", "proxy.budget.num_envs=2", "proxy.budget.steps=16"]
SMALL = {"oil": ["learner=linear", "learner.validate=false"], "dagger": ["learner=linear"]}
REPLAY = ["learner.batch_size=8", "learner.updates_per_step=0.125", "learner.starts=16"]
REPLAY += ["learner.hidden=[8]", "learner.critics=3"]
SMALL |= {
    # The tests take most of the frames; two updates are left.
    "coil_anchored": [*PPO, "training.tests.time_limit=0.5", "budget.frames=256"],
    "cheq": REPLAY,
    "policy_decorator": REPLAY,
    "q_filter": REPLAY,
    "ibrl": [*REPLAY, "learner.edit=0.2", "method.transforms.takeover.frames=32"],
}
SMALL["tune"] = ["tune={gain: [0.1, 2]}", "training.tests.time_limit=0.5"]
SMALL |= {method: [*REPLAY, "method.transforms.takeover.frames=32"] for method in ("rlpd", "wsrl")}
# Twice 64 frames of proxies, and two updates.
DYNAMIC = [*SMALL_PROXY, "budget.frames=256"]
SMALL |= {method: DYNAMIC for method in METHODS if method.startswith("dynamic")}


def composed(method, folder, *overrides):
    words = [*TINY, f"method={method}", *SMALL.get(method, PPO), *overrides, f"run_dir={folder}"]
    return composed_words(*words)


def trained(folder, method, *overrides):
    config = composed(method, folder, *overrides)
    check(config)
    train(config)
    return folder
