import numpy as np
import pytest
from ovals import ring_track

from coil_rl.cones.track_plot import TrackPlot
from coil_rl.envs import Track, robot_track


@pytest.mark.parametrize(("scale", "bar"), [(7, "10 m"), (1, "1 m")])
def test_scale_bar_is_a_round_length_that_fits(scale, bar):
    track = robot_track()
    plot = TrackPlot([Track("scaled", left=scale * track.left, right=scale * track.right)])
    assert bar in [text.get_text() for text in plot.axes.texts]
    line = next(line for line in plot.axes.lines if len(line.get_xdata()) == 4)
    assert np.ptp(line.get_xdata()) == pytest.approx(float(bar.removesuffix(" m")))


def test_tracks_are_in_rows_of_three_and_do_not_overlap():
    radii = np.array([8.0 + index % 3 for index in range(7)])
    tracks = [ring_track(str(index), radius) for index, radius in enumerate(radii)]
    centres = TrackPlot(tracks).offsets
    distances = np.linalg.norm(centres[:, None] - centres, axis=-1) + 1e9 * np.eye(7)
    assert (distances > radii[:, None] + radii + 2).all()
    assert len(np.unique((centres[:, 1] + radii).round(1))) == 3
