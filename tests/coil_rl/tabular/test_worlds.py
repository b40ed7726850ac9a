import numpy as np
import pytest

from coil_rl.tabular import Gridworld, garnet, toymaker, value_iteration


def test_the_toymaker_is_howards():
    mdp = toymaker()
    assert mdp.gamma == 0.95
    assert mdp.P[:, 0].tolist() == [[0.5, 0.5], [0.4, 0.6]]
    assert mdp.R[:, 0].tolist() == [[9, 3], [3, -7]]
    assert mdp.P[:, 1].tolist() == [[0.8, 0.2], [0.7, 0.3]]
    assert mdp.R[:, 1].tolist() == [[4, 4], [1, -19]]


def test_a_garnet_has_so_many_branches_and_is_its_seed():
    mdp = garnet(7, 3, np.random.default_rng(0), branches=2)
    assert ((mdp.P > 0).sum(axis=2) == 2).all()
    np.testing.assert_array_equal(mdp.R, garnet(7, 3, np.random.default_rng(0), branches=2).R)
    assert (mdp.R != garnet(7, 3, np.random.default_rng(1), branches=2).R).any()
    with pytest.raises(ValueError, match="branches=8 must be between 1 and states=7"):
        garnet(7, 3, np.random.default_rng(0), branches=8)


def test_who_slips_goes_aside_and_walls_stop():
    mdp = Gridworld(("G..", ".#.", "S.."), slip=0.2).mdp
    corner, above, beside = 5, 3, 6
    up, left = 0, 3
    assert mdp.P[corner, up, [above, corner, beside]] == pytest.approx([0.6, 0.2, 0.2])
    assert mdp.P[corner, left, [above, corner, beside]] == pytest.approx([0.2, 0.8, 0.0])
    assert mdp.start[corner] == 1
    assert mdp.terminal.tolist() == [True] + [False] * 7


def test_goals_and_pits_pay_once():
    mdp = Gridworld(("XSG",), slip=0, goal=5.0, pit=-7.0, step=-0.5).mdp
    assert mdp.r[1].tolist() == [-0.5, 4.5, -0.5, -7.5]
    assert not mdp.r[[0, 2]].any()
    assert value_iteration(mdp).V.tolist() == [0, 4.5, 0]


def test_a_slippery_floor_is_walked_with_care():
    plan = ("S.G", ".X.", "...")
    worth = [
        value_iteration(world.mdp).V @ world.mdp.start for world in (Gridworld(plan, slip=s) for s in (0, 0.1, 0.3))
    ]
    assert worth[0] > worth[1] > worth[2]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"plan": ("..", "...")}, "plan=.* must be rows of one length"),
        ({"plan": ("..G",)}, "at least one S"),
        ({"plan": ("S?G",)}, "of . # S G X"),
        ({"slip": 0.6}, "slip=0.6 must be between 0 and 0.5"),
    ],
)
def test_what_is_no_plan_is_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        Gridworld(**arguments)
