"""Guides that depend on the history of an episode."""

import itertools

import pytest
import torch
import worlds
from hosted_guides import cones
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.data import Unbounded
from torchrl.envs import (
    ParallelEnv,
    PendulumEnv,
    SerialEnv,
    TensorDictPrimer,
    TransformedEnv,
)
from torchrl.modules import GRUModule, LSTMModule

from coil_rl.guides import SplineGuide
from coil_rl.run.rollout import Rollout
from coil_rl.testing import check_env
from coil_rl.transforms import GuideActions, Guides, ResidualAction


class Integrator(TensorDictModuleBase):
    """Sums up an entry of the episode; begins with `first`."""

    def __init__(self, key="steering", first=0.0):
        self.in_keys, self.out_keys = [key, "total"], ["action", ("next", "total")]
        super().__init__()
        self.first = first

    def forward(self, tensordict):
        total = tensordict["total"] + tensordict[self.in_keys[0]]
        return tensordict.set("action", (total / 100).clamp(-1, 1)).set(("next", "total"), total)

    def make_tensordict_primer(self):
        return TensorDictPrimer(
            {"total": Unbounded((1,))}, default_value=self.first, expand_specs=True
        )


class Witness(TensorDictModuleBase):
    """Writes what GuideActions supplies: first step, row and last action."""

    in_keys, out_keys = ["is_init", "row", "last_action"], ["action"]

    def forward(self, tensordict):
        parts = [tensordict["is_init"], tensordict["row"] / 10, tensordict["last_action"] / 10]
        return tensordict.set("action", sum(part.float() for part in parts) / 10)


def recurrent(kind):
    torch.manual_seed(0)
    states = ["h", "c"][: 1 if kind is GRUModule else 2]
    core = kind(
        input_size=20,
        hidden_size=8,
        in_keys=["observation", *states],
        out_keys=["features", *(("next", state) for state in states)],
    )
    head = nn.Sequential(nn.Linear(8, 1), nn.Tanh())
    return TensorDictSequential(
        core, TensorDictModule(head, in_keys=["features"], out_keys=["action"])
    )


def episodes(rollout):
    """Yield the rows and slices of the episodes in a rollout [B, T]."""
    for row, done in zip(rollout, rollout["next", "done"].squeeze(-1), strict=True):
        ends = [0, *(done.nonzero().flatten() + 1).tolist(), len(done)]
        for start, end in itertools.pairwise(ends):
            yield row[start:end]


def driven(env, steps=80):
    torch.manual_seed(1)
    rollout = env.rollout(steps, break_when_any_done=False)
    assert rollout["next", "done"].sum() > 3, "resets should be covered"
    assert not rollout["next", "done"].all(1).any(), "rows should be reset one by one"
    return rollout


@pytest.mark.slow
def test_memory_begins_anew_with_every_episode_of_every_row():
    env = cones({"sum": Integrator(first=7.0), "spline": SplineGuide()})
    rollout = driven(env)
    for episode in episodes(rollout):
        expected = (7 + episode["steering"].cumsum(0)) / 100
        torch.testing.assert_close(episode["guide_action"][:, 0], expected)
        torch.testing.assert_close(episode["guide_state", "sum", "total"], expected * 100)
    assert set(rollout["guide_state"].keys()) == {"sum"}
    alone = driven(cones({"spline": SplineGuide()}))
    assert torch.equal(rollout["guide_action"][:, :, 1], alone["guide_action"][:, :, 0])


@pytest.mark.slow
@pytest.mark.parametrize("kind", [LSTMModule, GRUModule])
def test_recurrent_networks_of_torchrl_are_guides(kind):
    guide = recurrent(kind)
    for episode in episodes(driven(cones({"memory": guide}))):
        states = {key: torch.zeros(1, 1, 8) for key in guide.in_keys if key in ("h", "c")}
        for step in range(len(episode)):
            data = episode[step : step + 1].select("observation").update(states)
            with torch.no_grad():
                data = guide(data.set("is_init", torch.zeros(1, 1, dtype=torch.bool)))
            torch.testing.assert_close(data["action"], episode["guide_action"][step : step + 1, 0])
            states = {key: data["next", key] for key in states}


def test_specs_hold_and_reset_of_one_row_leaves_the_memory_of_the_others():
    check_env(cones({"memory": recurrent(LSTMModule), "sum": Integrator()}))


def test_guide_is_told_first_step_row_and_the_action_that_the_env_was_given():
    env = cones({"spline": SplineGuide(), "witness": Witness()}, ResidualAction(3.0))
    rollout = driven(env)
    given = (rollout["guide_action"][:, :, 0] + 3 * rollout["action"]).clamp(-1, 1)
    assert not torch.allclose(given, rollout["action"])
    first = torch.ones(6, 80, 1)
    first[:, 1:] = rollout["next", "done"][:, :-1].float()
    last = torch.cat([torch.zeros(6, 1, 1), given[:, :-1]], 1) * (1 - first)
    rows = torch.arange(6.0).view(6, 1, 1)
    told = (first + rows / 10 + last / 10) / 10
    torch.testing.assert_close(rollout["guide_action"][:, :, 1], told)


class Speed(Integrator):
    """Sums up the speed of TorchRL's pendulum, a number without a dimension."""

    def __init__(self):
        super().__init__("thdot")

    def forward(self, tensordict):
        return super().forward(tensordict.set("thdot", tensordict["thdot"].unsqueeze(-1)))


def inside():
    return TransformedEnv(PendulumEnv(), GuideActions({"sum": Speed()}))


@pytest.mark.fast("inside", "around")
@pytest.mark.parametrize(
    "make",
    [
        lambda: SerialEnv(2, inside),
        lambda: TransformedEnv(SerialEnv(2, PendulumEnv), GuideActions({"sum": Speed()})),
        lambda: ParallelEnv(2, inside),
    ],
    ids=["inside", "around", "parallel"],
)
def test_memory_works_inside_and_around_an_env_of_several_envs(make):
    env = make()
    rollout = env.rollout(5)
    torch.testing.assert_close(
        rollout["guide_action"][..., 0, :], rollout["thdot"].cumsum(1).unsqueeze(-1) / 100
    )
    before, total = rollout[:, -1]["next"].clone(), ("guide_state", "sum", "total")
    mask = torch.tensor([[True], [False]])
    after = env.reset(before.clone().set("_reset", mask), set_state=False)
    assert after[total][1] == before[total][1] != after[total][0]
    assert after[total][0].abs() < 1.1, "the first speed is at most 1"
    env.close()


def test_resumed_rollout_is_equal_to_the_bit():
    policy = TensorDictModule(lambda seen: torch.tanh(seen[:, :1]), ["observation"], ["action"])

    def rollout(seed):
        guides = {"memory": recurrent(LSTMModule), "sum": Integrator()}
        return Rollout(cones(guides, seed=seed), policy, 20)

    expected, resumed = worlds.continued(rollout)
    assert (expected == resumed).all()
    assert expected["guide_state", "sum", "total"].abs().sum() > 0


FORGETS = TensorDictModule(nn.Linear(1, 2), ["a"], ["action", ("next", "b")])


def alone(guide):
    """Let a guide of an env act on data of one step."""
    return cones({"guide": guide}).transform[0](worlds.cones().reset())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GuideActions({"pi": FORGETS}), r"'pi' writes \['b'\] for its next step, but"),
        (lambda: Guides({"pi": recurrent(GRUModule)}, trainable=True), "'pi' has a memory, and"),
        (lambda: alone(Integrator()), "GuideActions needs the previous steps"),
        (lambda: alone(Witness()), "GuideActions needs the previous steps"),
        (
            lambda: cones(
                {"a": Integrator()}, GuideActions({"a": Integrator()}, out_key="b")
            ).reset(),
            "two guides 'a' have a memory",
        ),
    ],
)
def test_memory_that_cannot_be_kept_is_refused(make, message):
    with pytest.raises((ValueError, RuntimeError), match=message):
        make()
