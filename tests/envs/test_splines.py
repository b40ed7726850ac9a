"""Properties of the batched splines, compared with SciPy and NumPy."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import make_smoothing_spline

from coil_rl.envs.splines import least_squares_parabola, smoothing_spline

SLOTS = 16
FITS = {
    "smoothing": lambda points, count: smoothing_spline(points, count, 0.3),
    "interpolating": lambda points, count: smoothing_spline(points, count, 0.0),
    "parabola": least_squares_parabola,
}
every_fit = pytest.mark.parametrize("fit", FITS.values(), ids=FITS.keys())
steady = settings(max_examples=40)
seeds = st.integers(0, 2**31)


def random_batch(dtype=torch.float64, batch=37):
    """Random walks [2, SLOTS, batch] and their numbers of real points [batch]."""
    draw = torch.Generator().manual_seed(3)
    points = torch.randn(2, SLOTS, batch, dtype=dtype, generator=draw).cumsum(1)
    return points, torch.randint(0, SLOTS + 1, (batch,), generator=draw)


def tensors(spline):
    return spline.knots, spline.values, spline.bends, spline.equidistant(7)


def separated(seed, n):
    """Random walk of n points with steps of 0.5 to 2 m: [2, n]."""
    rng = np.random.default_rng(seed)
    step = rng.normal(size=(2, n))
    step *= rng.uniform(0.5, 2, n) / np.linalg.norm(step, axis=0)
    return step.cumsum(1)


def padded(rows, slots=SLOTS, garbage=7.0):
    """Return padded points, and their numbers."""
    points = torch.full((rows[0].shape[0], slots, len(rows)), garbage, dtype=torch.float64)
    for i, row in enumerate(rows):
        points[:, : row.shape[1], i] = torch.from_numpy(row)
    return points, torch.tensor([row.shape[1] for row in rows])


def chord(row):
    return np.concatenate([[0], np.linalg.norm(np.diff(row), axis=0).cumsum()])


@steady
@given(seeds, st.integers(5, SLOTS), st.sampled_from([1e-4, 0.01, 0.1, 1.0, 30.0]))
def test_smoothing_spline_agrees_with_scipy(seed, n, smoothing):
    row = separated(seed, n)
    u = chord(row)
    spline = smoothing_spline(*padded([row]), smoothing)
    where = np.linspace(0, u[-1], 23)
    sampled = spline.along(torch.from_numpy(where / u[-1])[:, None])[..., 0].numpy()
    for d in range(2):
        truth = make_smoothing_spline(u, row[d], lam=smoothing)
        assert spline.values[d, :n, 0].numpy() == pytest.approx(truth(u), abs=1e-9)
        assert spline.bends[d, :n, 0].numpy() == pytest.approx(truth.derivative(2)(u), abs=1e-8)
        assert sampled[d] == pytest.approx(truth(where), abs=1e-9)
    assert spline.knots[-1].item() == pytest.approx(u[-1], abs=1e-12)


@pytest.mark.parametrize("n", [2, 3, 4])
@pytest.mark.parametrize("smoothing", [0.01, 1.0])
def test_smoothing_spline_of_few_points_minimises_the_penalised_squares(n, smoothing):
    row = separated(n, n)
    h = np.diff(chord(row))
    second = np.zeros((n - 2, n))
    weight = np.zeros((n - 2, n - 2))
    for i in range(n - 2):
        second[i, i : i + 3] = 1 / h[i], -1 / h[i] - 1 / h[i + 1], 1 / h[i + 1]
        weight[i, i] = (h[i] + h[i + 1]) / 3
    for i in range(n - 3):
        weight[i, i + 1] = weight[i + 1, i] = h[i + 1] / 6
    roughness = second.T @ np.linalg.solve(weight, second)
    truth = np.linalg.solve(np.eye(n) + smoothing * roughness, row.T).T
    values = smoothing_spline(*padded([row]), smoothing).values[:, :n, 0]
    assert values.numpy() == pytest.approx(truth, abs=1e-9)


@pytest.mark.parametrize("gap", [0.02, 0.05, 0.2])
def test_close_points_cost_no_digits_in_float32(gap):
    along = torch.tensor([0.0, 1.0, 1.0 + gap, 2.5, 2.5 + gap, 4.0])
    points = torch.stack([along, 0.3 * torch.sin(3.0 * along)]).unsqueeze(-1)
    found = smoothing_spline(points, torch.tensor([6.0]), 0.3)
    knots = found.knots.squeeze(-1).double().numpy()
    for values, positions in zip(found.values.squeeze(-1), points.squeeze(-1), strict=True):
        expected = make_smoothing_spline(knots, positions.double().numpy(), lam=0.3)(knots)
        assert np.abs(values.numpy() - expected).max() < 1e-6


@steady
@given(seeds, st.integers(2, SLOTS))
def test_parabola_agrees_with_numpy(seed, n):
    row = separated(seed, n)
    u = chord(row)
    where = np.linspace(0, u[-1], 41)
    parabola = np.stack([np.polyval(np.polyfit(u, axis, min(2, n - 1)), where) for axis in row])
    curve = least_squares_parabola(*padded([row]))
    sampled = curve.along(torch.from_numpy(where / u[-1])[:, None])[..., 0]
    assert sampled.numpy() == pytest.approx(parabola, abs=1e-9)


@every_fit
def test_float32_is_close_to_float64(fit):
    points, count = padded([100 + separated(n, n) for n in range(2, SLOTS + 1)])
    single = fit(points.float(), count).equidistant(9)
    assert torch.allclose(single.double(), fit(points, count).equidistant(9), atol=2e-3)


@pytest.mark.parametrize("gap", [0.0, 1e-4, 1e-2])
@pytest.mark.parametrize("smoothing", [0.1, 10.0])
def test_nearly_coincident_points_count_as_one_of_double_weight(gap, smoothing):
    # Midpoints of neighbouring cone pairs are this close; the normal equations lose most digits
    # here.
    row = separated(1, 8)
    row = np.insert(row, 4, row[:, 3] + [gap, 0], axis=1)
    points, count = padded([row])
    u = chord(np.delete(row, 4, axis=1))
    weights = np.where(np.arange(8) == 3, 2.0, 1.0)
    for dtype in (torch.float32, torch.float64):
        values = smoothing_spline(points.to(dtype), count, smoothing).values[:, :9, 0]
        values = torch.cat([values[:, :4], values[:, 5:]], 1).numpy()
        for d in range(2):
            truth = make_smoothing_spline(u, np.delete(row, 4, axis=1)[d], w=weights, lam=smoothing)
            assert values[d] == pytest.approx(truth(u), abs=0.01 + 2 * gap)


@every_fit
def test_no_points_give_zeros_one_a_constant_two_a_line(fit):
    rows = [np.zeros((2, 0)), np.array([[3.0], [4.0]]), np.array([[1.0, 4.0], [1.0, 5.0]])]
    spline = fit(*padded(rows, garbage=-50.0))
    at = spline.equidistant(3)
    assert at[:, :, 0].eq(0).all()
    assert spline.values[..., 0].eq(0).all()
    assert at[:, :, 1] == pytest.approx(np.repeat([[3.0], [4.0]], 3, 1))
    assert at[:, :, 2] == pytest.approx(np.array([[1, 2.5, 4], [1, 3, 5]]))
    assert spline.knots[-1].tolist() == pytest.approx([0, 0, 5])


@every_fit
@pytest.mark.parametrize("slots", [2, 3, 4, 5])
def test_results_do_not_depend_on_the_number_of_slots(fit, slots):
    rows = [separated(5, n) for n in range(1, slots + 1)]
    few, many = fit(*padded(rows, slots)), fit(*padded(rows))
    assert torch.equal(few.equidistant(6), many.equidistant(6))


@every_fit
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_padding_does_not_change_results(fit, dtype):
    points, count = random_batch(dtype)
    padding = torch.arange(SLOTS)[:, None] >= count
    for garbage in (0.0, -1e6, 1e30):
        other = fit(points.masked_fill(padding, garbage), count)
        for a, b in zip(tensors(fit(points, count)), tensors(other), strict=True):
            assert torch.equal(a, b)


@steady
@given(seeds, st.integers(2, SLOTS), st.floats(-3, 3), st.floats(-100, 100))
def test_splines_are_equivariant_to_rigid_motions_and_reversal(seed, n, angle, shift):
    row = separated(seed, n)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for fit in FITS.values():
        rows = [row, turn @ row + shift, row[:, ::-1].copy()]
        curve, moved, reverse = np.moveaxis(fit(*padded(rows)).equidistant(6).numpy(), -1, 0)
        assert moved == pytest.approx(turn @ curve + shift, abs=1e-8)
        assert reverse == pytest.approx(curve[:, ::-1], abs=1e-8)


@every_fit
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_do_not_depend_on_the_other_rows_or_the_batch_shape(fit, dtype):
    points, count = random_batch(dtype, batch=24)
    whole = tensors(fit(points, count))
    for rows in (slice(0, 1), slice(5, 6), slice(3, 20)):
        few = tensors(fit(points[..., rows].contiguous(), count[rows]))
        assert all(torch.equal(a[..., rows], b) for a, b in zip(whole, few, strict=True))
    for shape in ((2, 12), (2, 3, 4)):
        shaped = tensors(fit(points.view(2, SLOTS, *shape), count.view(shape)))
        for a, b in zip(whole, shaped, strict=True):
            assert torch.equal(a, b.flatten(-len(shape)))
    assert fit(points[..., :0], count[:0]).equidistant(5).shape == (2, 5, 0)


SHAPES = {
    "identical": lambda i: (0 * i + 3.0, 0 * i - 2.0),
    "pairs": lambda i: ((i // 2) * 1.3, (i // 2) ** 2 * 0.1),
    "collinear": lambda i: (i * 0.7, i * -0.3),
    "there and back": lambda i: (i % 2, 0 * i),
    "far away": lambda i: (1e3 + (i % 5) * 0.9, -1e3 + i * 0.5),
    "barely apart": lambda i: (5 + i * 1e-6, 5 - i * 1e-7),
    "clump and jump": lambda i: (np.where(i < 7, 1e-5 * i, 1e3), 0 * i),
    "huge": lambda i: (1e3 * np.cos(i), 1e3 * np.sin(i)),
}
AWKWARD = [0.0, 1.0, 1 + 1e-7, 1e-30, -2.5, 1e3, 1e3 + 1e-4]
shapes = st.sampled_from(sorted(SHAPES)).map(lambda name: np.stack(SHAPES[name](np.arange(SLOTS))))
points = st.tuples(st.sampled_from(AWKWARD), st.sampled_from(AWKWARD))
lists = st.lists(points, min_size=SLOTS, max_size=SLOTS).map(lambda rows: np.array(rows).T)
degenerate = shapes | lists


@pytest.mark.slow
@steady
@given(degenerate, st.sampled_from([0.0, 1e-4, 0.1, 10.0, 1e3]), st.booleans())
def test_results_and_gradients_are_finite_for_any_points(row, smoothing, single):
    dtype = torch.float32 if single else torch.float64
    points = torch.from_numpy(row).to(dtype)[..., None].repeat(1, 1, SLOTS + 1)
    count = torch.arange(SLOTS + 1)
    for fit in (lambda *a: smoothing_spline(*a, smoothing), least_squares_parabola):
        leaf = points.clone().requires_grad_()
        spline = fit(leaf, count)
        fractions = torch.linspace(0, 1, 4, dtype=dtype)[:, None].expand(4, SLOTS + 1)
        results = (*tensors(spline), spline.along(fractions))
        (gradient,) = torch.autograd.grad(sum(x.sum() for x in results), leaf)
        assert all(x.isfinite().all() for x in (*results, gradient))


@pytest.mark.fast(3)
@every_fit
@pytest.mark.parametrize("n", [2, 3, 6])
def test_gradients_agree_with_finite_differences(fit, n):
    points, count = padded([separated(4, n), separated(8, n)], slots=6)
    assert torch.autograd.gradcheck(lambda p: tensors(fit(p, count))[1:], points.requires_grad_())
    fractions = torch.tensor([[0.3, 0.2], [0.9, 0.7]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p, at: fit(p, count).along(at), (points, fractions))
