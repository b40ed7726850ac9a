import numpy as np
import pytest

from coil_rl.tabular import garnet, toymaker


def test_the_toymaker_has_howards_numbers():
    mdp = toymaker()
    assert mdp.gamma == 0.95
    assert mdp.P[:, 0].tolist() == [[0.5, 0.5], [0.4, 0.6]]
    assert mdp.R[:, 0].tolist() == [[9, 3], [3, -7]]
    assert mdp.P[:, 1].tolist() == [[0.8, 0.2], [0.7, 0.3]]
    assert mdp.R[:, 1].tolist() == [[4, 4], [1, -19]]


def test_a_garnet_has_the_given_branches_and_is_reproducible():
    mdp = garnet(7, 3, np.random.default_rng(0), branches=2)
    assert ((mdp.P > 0).sum(axis=2) == 2).all()
    np.testing.assert_array_equal(mdp.R, garnet(7, 3, np.random.default_rng(0), branches=2).R)
    assert (mdp.R != garnet(7, 3, np.random.default_rng(1), branches=2).R).any()
    with pytest.raises(ValueError, match="branches=8 must be between 1 and states=7"):
        garnet(7, 3, np.random.default_rng(0), branches=8)
