"""What DQN and SAC have in common as parts of an experiment."""

import pytest
import torch
from torchrl.envs import Compose, RewardSum, TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import RandomGuide
from coil_rl.learners import DQN, SAC
from coil_rl.train.experiment import Experiment, watched_keys
from coil_rl.train.rollout import Rollout
from coil_rl.transforms import DelayedAdvice, DiscreteActions, GuideActions

TINY = {"starts": 20, "batch_size": 16, "ratio": 2, "capacity": 90, "hidden": [8]}
SEEN = ["observation", "guide_action"]


def experiment(folder, kind, seed=0):
    """Advice that is drawn and then delayed, so that nobody could ask for it again."""
    torch.manual_seed(seed)
    folder.mkdir(exist_ok=True)
    advice = [GuideActions({"any": RandomGuide(seed=seed)}), DelayedAdvice(2)]
    choices = [DiscreteActions(5)] if kind is DQN else []
    env = ConeTrackEnv(shipped_tracks("train")[:2], 8, seed=seed)
    env = TransformedEnv(env, Compose(*advice, *choices, RewardSum()))
    learner = kind(env, SEEN, seed=seed, **TINY)
    rollout = Rollout(env, learner.policy, 4, [*learner.keys, *watched_keys(env, {})])
    return Experiment(learner, rollout, 8 * 4 * 6, folder, checkpoint_every=1)


class Killed(BaseException):
    pass


@pytest.mark.parametrize(("kind", "updates"), [(DQN, 1), (SAC, 4)])
def test_a_run_that_was_stopped_ends_with_the_files_of_one_that_never_was(tmp_path, kind, updates):
    """Before the replay is full and after."""
    whole = experiment(tmp_path / "whole", kind)
    rows = whole.run()
    assert rows[-1]["learner/kept"] == 90

    stopped = experiment(tmp_path / "stopped", kind)
    save = stopped._save

    def dying():
        save()
        if stopped.updates == updates:
            raise Killed

    stopped._save = dying
    with pytest.raises(Killed):
        stopped.run()
    # Another seed: nothing may depend on how the second process begins.
    again = experiment(tmp_path / "stopped", kind, seed=9)
    again.resume()
    again.run()
    for name in ("metrics.csv", "policy_last.pt", "policy_best.pt"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "stopped" / name).read_bytes(), name
    ours, theirs = again.learner.replay.buffer[:], whole.learner.replay.buffer[:]
    assert (ours == theirs).all()


@pytest.mark.parametrize("kind", [DQN, SAC])
def test_a_step_is_kept_with_the_advice_before_and_after_it(tmp_path, kind):
    run = experiment(tmp_path / "run", kind)
    batch = run.rollout.collect()
    run.learner.update(batch)
    kept, given = run.learner.replay.buffer[:], batch.select(*run.learner.replay.kept).reshape(-1)
    assert len(kept) == 32
    for key in ("guide_action", ("next", "guide_action"), "action"):
        assert torch.equal(kept[key], given[key])
    assert not torch.equal(kept["guide_action"], kept["next", "guide_action"])


@pytest.mark.parametrize("kind", [DQN, SAC])
def test_learning_begins_when_enough_is_kept(tmp_path, kind):
    run = experiment(tmp_path / "run", kind)
    run.learner.replay.starts = 40
    first, second = (run.learner.update(run.rollout.collect()) for _ in range(2))
    assert first["minibatches"] == 0
    assert second["minibatches"] == 8
    assert {value for name, value in first.items() if name.startswith(("loss", "value", "alpha"))} == {0.0}
