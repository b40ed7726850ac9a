"""Runs of any method that have learned from one batch, in a room with a heater."""

from outside_package.install import PROXY

import coil_rl

STEPS = 20
SHORT = ["evaluation.cases=2", "evaluation.gif=false", f"env.max_steps={STEPS + 4}"]
# No test looks at a curve.
TINY = ["budget.num_envs=2", "budget.steps=16", "logger=none", *SHORT]
TINY += [f"~evaluation.curve.cases.{name}" for name in ("evaluation", "selection")]
REPLAY = ["learner.starts=16", "learner.updates_per_step=0.0625", "learner.batch_size=16"]
ON_POLICY = ["learner.minibatches=2", "learner.epochs=1", "learner.action_gain=1"]
FOREST = ["learner.regressor.n_estimators=3"]
# What makes a method small, and its policy do something before it has learned anything.
OPTIONS = dict.fromkeys(("cheq", "ibrl", "policy_decorator", "rlpd", "wsrl", "q_filter"), REPLAY)
OPTIONS |= {"dagger": FOREST, "oil": FOREST, "coil_anchored": ["learner=ppo", *ON_POLICY[:2]]}


def learned(
    folder,
    method,
    *overrides,
    guide="thermostat.control:PI",
    env="thermostat:Room-v0",
    options=None,
):
    """Return the folder of a run that has learned from one batch.

    Args:
        options: what makes its learner small; None: what does it for that of the method.
    """
    words, frames = [*TINY, *(options or OPTIONS.get(method, ON_POLICY))], 32
    if method == "guide":  # it learns nothing
        words, frames = SHORT, None
    elif method == "tune":  # it has no learner
        words = [*SHORT, "logger=none"]
    if method.startswith("dynamic_coil"):
        words += [*PROXY, f"proxy.folder={folder}_proxies"]
        frames += 192  # those of its proxies
    run = coil_rl.prepare(
        env,
        guide=None if method == "ppo" else guide,
        method=method,
        frames=frames,
        folder=folder,
        overrides=[*words, *overrides],
    )
    run.begin()
    if method != "guide":
        run.learn()
    return folder
