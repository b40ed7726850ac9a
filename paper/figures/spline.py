"""Draw the smoothing spline of appendix A.2 through noisy cones for several lambda, and SciPy's.

There is one for each of several lambda. The spline minimises sum |y_i - f(u_i)|^2 + lambda *
integral |f''|^2 du over the chord length u. lambda = 0 passes through every point; a larger one
trades distance from the points for a straighter curve. The car estimates boundaries with lambda =
0.1 m^3, the guide's path has lambda = 1 m^3.

    python -m coil_paper.figures.spline [OUTPUT FOLDER]
"""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.lines import Line2D
from scipy.interpolate import make_smoothing_spline

from coil_paper.figures.ego_view import marker, output_folder, rows
from coil_rl.envs import shipped_track, smoothing_spline
from coil_rl.report import markdown_table, style

SMOOTHINGS = (0.0, 0.1, 1.0, 10.0, 100.0)  # lambda, m^3
CONES = 16  # of the left side of test_3
NOISE = 0.25  # m, standard deviation along each axis
CURVE_POINTS = 400


def main() -> None:
    """Draw spline.png and print the fits."""
    path = output_folder(__doc__) / "spline.png"
    cones = shipped_track("test_3").left[:CONES]
    points = cones + np.random.default_rng(0).normal(0, NOISE, cones.shape)
    strokes = style.strong_strokes(f"λ = {smoothing:g}" for smoothing in SMOOTHINGS)
    lines = {
        label: {"color": s.colour, "ls": s.linestyle, "lw": 1.8} for label, s in strokes.items()
    }
    handles = [
        *(Line2D([], [], label=label, **line) for label, line in lines.items()),
        marker(".", "SciPy's, all λ", 4, color=style.INK),
        marker("o", "noisy cone", 7, mfc="none", mec=style.INK, mew=0.9),
        marker("+", "true cone", 6, color=style.QUIET),
    ]
    fits = []
    with style.picture(
        path, "The smoothing spline for several λ, and SciPy's", handles, height=6.2
    ) as figure:
        plane, bends = figure.subplots(2, 1, height_ratios=(2.3, 1))
        plane.set_aspect("equal", adjustable="datalim")
        plane.set(xlabel="m", ylabel="m")
        plane.plot(*cones.T, "+", ms=6, color=style.QUIET, zorder=2)
        plane.plot(*points.T, "o", ms=7.5, mfc="none", mec=style.INK, mew=0.9, zorder=5)
        for smoothing, line in zip(SMOOTHINGS, lines.values(), strict=True):
            spline = smoothing_spline(
                torch.tensor(points.T).unsqueeze(-1), torch.tensor([CONES]), smoothing
            )
            u = spline.knots[:, 0].numpy()
            reference = make_smoothing_spline(u, points, lam=smoothing)
            curve, expected = (
                rows(spline.equidistant(CURVE_POINTS)[..., 0]),
                reference(np.linspace(0, u[-1], CURVE_POINTS)),
            )
            plane.plot(*curve.T, zorder=3, **line)
            plane.plot(*expected[::8].T, ".", ms=2.2, color=style.INK, zorder=4)
            bends.plot(u, np.hypot(*spline.bends[..., 0].numpy()), **line)
            bends.plot(
                u, np.hypot(*reference.derivative(2)(u).T), ".", ms=3, color=style.INK, zorder=4
            )
            fits.append(
                {
                    "smoothing": smoothing,
                    "difference": np.hypot(*(curve - expected).T).max(),
                    "residual": ((rows(spline.values[..., 0]) - points) ** 2).sum(),
                    "error": np.sqrt(((rows(spline.values[..., 0]) - cones) ** 2).sum(1).mean()),
                }
            )
        bends.set(
            xlabel="u, chord length from point to point (m)", ylabel="|f''| (1/m)", xlim=(0, u[-1])
        )
        bends.set_ylim(bottom=0)
        style.lighten(plane)
        style.lighten(bends)
    columns = {
        "smoothing": ("λ (m³)", "g"),
        "difference": ("largest difference from SciPy (m)", ".1e"),
        "residual": ("residual sum (m²)", ".4f"),
        "error": ("RMS distance from the true cones (m)", ".3f"),
    }
    print(f"{markdown_table(fits, columns)}\n{path}")


if __name__ == "__main__":
    main()
