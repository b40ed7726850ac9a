"""The training of a run, put together from its parts."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.compiled import compile_steps
from coil_rl.output import say
from coil_rl.report.runs import EVALUATION
from coil_rl.run import checkpoint
from coil_rl.run.cases import TrainingCases
from coil_rl.run.curve import EvaluationCurve
from coil_rl.run.delivery import Delivery
from coil_rl.run.experiment import Experiment, watched_keys
from coil_rl.run.folder import weights_file
from coil_rl.run.parts import TESTS
from coil_rl.run.rollout import Rollout
from coil_rl.transforms.normalised_action import given_units, units_of

if TYPE_CHECKING:
    from coil_rl.run.run import Run

INIT = "init.pt"  # the policy that a run began from


def training_of(run: Run, before: int) -> Experiment:
    """Return the training of a run, whose env and learner are made here.

    Args:
        before: frames that were taken before it.
    """
    env = run.make_env(run.budget.rows)
    _say_units(env)
    if run.compiled:
        compile_steps(env)
    learner = run.require_agent()(env)
    if run.init is not None:
        init = _copy_of_init(run.folder, run.init)
        checkpoint.put_weights(learner.policy, checkpoint.load(init, run.device), init)
    keys = [*learner.keys, *watched_keys(env, run.watch)]
    rollout = Rollout(env, learner.policy, run.budget.steps, keys, run.noise_correlation)
    make_env = partial(run.make_env, cases=TESTS)
    cases = TrainingCases(make_env, run.budget.frames, run.seed, run.noise_correlation)
    curve = _curve_of(run, learner.policy)
    callbacks = [*learner.callbacks(cases), *run.callbacks(learner)]
    reserve = None
    if run.delivery == "tested":
        delivery = Delivery(learner, env, cases, curve, run.folder)
        callbacks.append(delivery)
        reserve = delivery.reserve
    return Experiment(
        learner,
        rollout,
        run.budget.frames,
        run.folder,
        logger=run.logger() if run.logger is not None else None,
        watch=run.watch,
        checkpoint_every=run.budget.checkpoint_every,
        callbacks=callbacks,
        curve=curve,
        cases=cases,
        reserve=reserve,
        before=before,
        identity=run.identity,
        stages=run.budget.stages,
        resume_command=run.resume_command,
    )


def _copy_of_init(folder: Path, init: Path) -> Path:
    """Return a run's own copy of the policy that it begins with.

    Args:
        init: folder of the run whose policy that is.
    """
    copy = folder / INIT
    if not copy.exists():
        checkpoint.save(checkpoint.load(weights_file(Path(init))), copy)
    return copy


def _curve_of(run: Run, policy: TensorDictModuleBase) -> EvaluationCurve:
    """Return the evaluation curve of a run; it has no sets where there are no such cases."""
    sets = [*run.make_env.sizes] if EVALUATION in run.make_env.sizes else []
    if run.delivery == "tested":  # an earlier policy is chosen by the test at the end
        sets = [each for each in sets if each == EVALUATION]
    return EvaluationCurve(
        run.folder,
        policy,
        run.make_env,
        sets,
        watch=run.watch,
        points=run.budget.points,
        batches=run.budget.batches,
    )


def _say_units(env: EnvBase) -> None:
    """Print the units in which an action that lacks bounds is normalised."""
    if len(env.action_keys) != 1:
        return
    spec = env.full_action_spec[env.action_key]
    units = given_units(env) or units_of(spec, len(env.batch_size))
    if units is not None and units.assumed:
        say(f"action: {'; '.join(units.assumed)}", error=True)
