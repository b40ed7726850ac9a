import numpy as np
import pytest

from coil_rl.envs import ConeClassifier, simulated_cone_classifier


def one_vector(**changed) -> ConeClassifier:
    """A single support vector: exp(-0.5 |x - s|^2) of features in cm, less a half."""
    numbers = {"mean": [0.0, 0], "scale": [0.01, 0.01], "support": [[3.0, 4]], "weights": [1.0], "intercept": -0.5}
    return ConeClassifier(**{**numbers, "gamma": 0.5, **changed})


def test_the_decision_is_the_kernel_expansion():
    found = one_vector().decision(np.array([[0.03, 0.04], [0.0, 0.0], [0.04, 0.04]]))
    np.testing.assert_allclose(found, [0.5, np.exp(-12.5) - 0.5, np.exp(-0.5) - 0.5], atol=1e-12)
    assert one_vector().thick(np.array([[0.03, 0.04], [0.0, 0.0]])).tolist() == [True, False]


def test_a_cluster_is_told_by_itself_however_many_there_are():
    features = np.random.default_rng(0).uniform(0, 0.12, (9000, 3))
    classifier = simulated_cone_classifier()
    together = classifier.decision(features)
    np.testing.assert_allclose(together[[0, 4095, 4096, 8999]], classifier.decision(features[[0, 4095, 4096, 8999]]))
    assert classifier.decision(features[:0]).shape == (0,)


def test_the_shipped_one_tells_what_a_thin_and_a_thick_cone_measure():
    assert simulated_cone_classifier().thick([[0.03, 0.01, 0.035], [0.085, 0.03, 0.1]]).tolist() == [False, True]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"weights": [1.0, 2.0]}, r"weights \[2\] must be \[1\]"),
        ({"mean": [0.0]}, r"mean \[1\] must be \[2\]"),
        ({"support": [1.0, 2.0]}, r"support \[2\] must be \[S, F\]"),
        ({"gamma": -1.0}, "more than 0"),
        ({"scale": [1.0, 0.0]}, "more than 0"),
        ({"intercept": np.nan}, "intercept of a cone classifier holds a number that is not finite"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(changed, said):
    with pytest.raises(ValueError, match=said):
        one_vector(**changed)
