import numpy as np
import pytest
from PIL import Image

from coil_rl.report import style
from coil_rl.report.cone_features import draw_cone_features, principal_components


def clusters(count=300, seed=0):
    rng = np.random.default_rng(seed)
    thick = rng.random(count) < 0.5
    width = np.where(thick, 0.08, 0.035) + rng.normal(0, 0.006, count)
    return np.stack([width, rng.uniform(0, 0.02, count), 1.2 * width + rng.normal(0, 0.001, count)], axis=1), thick


def test_the_components_are_those_of_the_correlations():
    features, _ = clusters()
    place, axes, share = principal_components(features)
    value, vector = np.linalg.eigh(np.corrcoef(features.T))
    np.testing.assert_allclose(share, value[::-1][:2] / 3)
    np.testing.assert_allclose(np.abs(axes), np.abs(vector[:, ::-1][:, :2]), atol=1e-9)
    np.testing.assert_allclose(place.var(axis=0), value[::-1][:2])
    np.testing.assert_allclose(place.mean(axis=0), 0, atol=1e-12)
    assert (np.abs(axes).max(axis=0) == axes.max(axis=0)).all()


def test_units_do_not_matter():
    features, _ = clusters()
    first, second = (principal_components(features * units)[0] for units in ([1, 1, 1], [1000, 1, 0.01]))
    np.testing.assert_allclose(first, second, atol=1e-9)


def pixels(path):
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def coloured(image, colour):
    wanted = [int(colour[at : at + 2], 16) for at in (1, 3, 5)]
    return int((np.abs(image - wanted).max(axis=-1) < 80).sum())


def test_both_kinds_are_drawn_in_the_colours_of_their_cones(tmp_path):
    features, thick = clusters()
    draw_cone_features(features, thick, tmp_path / "both.png", title="Clusters (simulated)")
    draw_cone_features(features, np.zeros_like(thick), tmp_path / "thin.png", title="Clusters (simulated)")
    both, thin = (pixels(tmp_path / f"{name}.png") for name in ("both", "thin"))
    assert both.shape[1] == style.WIDTH * style.RESOLUTION
    assert coloured(both, style.LEFT_CONE) > 2000
    assert coloured(both, style.RIGHT_CONE) > 2000
    assert coloured(thin, style.RIGHT_CONE) < 1000  # the legend's


def test_errors_get_a_ring(tmp_path):
    features, thick = clusters()
    wrong = np.arange(len(thick)) < 40
    draw_cone_features(features, thick, tmp_path / "right.png")
    draw_cone_features(features, thick, tmp_path / "wrong.png", wrong=wrong)
    dark = [int((pixels(tmp_path / f"{name}.png").max(axis=-1) < 90).sum()) for name in ("right", "wrong")]
    assert dark[1] > dark[0] + 1000


def test_what_does_not_fit_is_refused(tmp_path):
    features, thick = clusters()
    with pytest.raises(ValueError, match=r"features \[300\] must be \[N, F\]"):
        principal_components(features[:, 0])
    with pytest.raises(ValueError, match="none of them the same"):
        principal_components(features * [1, 0, 1])
    with pytest.raises(ValueError, match="for 300 clusters of 3 features"):
        draw_cone_features(features, thick[1:], tmp_path / "x.png")
