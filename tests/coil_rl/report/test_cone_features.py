import numpy as np

from coil_rl.reproduce.classifier import draw_cone_features, principal_components


def clusters(count=300, seed=0):
    rng = np.random.default_rng(seed)
    thick = rng.random(count) < 0.5
    width = np.where(thick, 0.08, 0.035) + rng.normal(0, 0.006, count)
    return np.stack([width, rng.uniform(0, 0.02, count), 1.2 * width + rng.normal(0, 0.001, count)], axis=1), thick


def test_components_are_the_eigenvectors_of_the_correlation_matrix_in_any_units():
    features, _ = clusters()
    xy, directions, share = principal_components(features)
    values, vectors = np.linalg.eigh(np.corrcoef(features.T))
    np.testing.assert_allclose(share, values[::-1][:2] / 3)
    np.testing.assert_allclose(np.abs(directions), np.abs(vectors[:, ::-1][:, :2]), atol=1e-9)
    np.testing.assert_allclose(xy.var(axis=0), values[::-1][:2])
    np.testing.assert_allclose(xy.mean(axis=0), 0, atol=1e-12)
    assert (np.abs(directions).max(axis=0) == directions.max(axis=0)).all()
    np.testing.assert_allclose(principal_components(features * [1000, 1, 0.01])[0], xy, atol=1e-9)


def test_figure_is_written_with_and_without_errors(tmp_path):
    features, thick = clusters()
    for wrong in (None, np.arange(len(thick)) < 40):
        draw_cone_features(features, thick, tmp_path / "plot.png", wrong=wrong, title="Clusters (simulated)")
        assert (tmp_path / "plot.png").stat().st_size > 10_000
