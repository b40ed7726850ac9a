import numpy as np
import pytest
from programs import read_csv
from reproduced_runs import cells

from coil_paper.reproduce.classifier import Figure25, principal_components
from coil_rl.envs import RecordingError, SimulatedLidar, read_recording, save_drive, simulated_drive
from coil_rl.envs.recordings.mcap_files import RecordingWriter, read_messages
from coil_rl.envs.recordings.messages import ODOMETRY, SCAN
from coil_rl.envs.robot.drives import labelled_drive, record_labelling_drives
from coil_rl.errors import UserError
from coil_robot.classifier import accuracy, clusters_in_range, label_clusters, load_classifier


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    return record_labelling_drives(tmp_path_factory.mktemp("drives"), pairs=2, both=1)


@pytest.mark.slow
def test_the_page_has_the_accuracy_of_the_saved_classifier(drives, tmp_path):
    page = Figure25(**drives).make(tmp_path / "figure_25")
    tested = labelled_drive(read_recording(drives["both"][0]))
    shares = accuracy(load_classifier(tmp_path / "cones.json"), label_clusters([tested]))
    lines = [cells(line) for line in page.splitlines() if line.startswith("| ")]
    for name, share in shares.items():
        (line,) = (line for line in lines if line[:2] == ["accuracy", name])
        assert (line[2], line[-1]) == (f"{share.share:.4f}", str(share.total))
    (paper,) = (line for line in lines if line[0] == "paper, its own robot")
    assert (paper[2], *paper[-2:]) == ("0.9877", "3", "243")
    assert "| recall of thin cones " in page
    assert "| recall" not in Figure25(drives["left"], drives["right"]).make(tmp_path / "untested")
    assert (tmp_path / "figure_25.png").exists()
    rows = read_csv(tmp_path / "figure_25.csv")
    (measured,) = (row for row in rows if (row["measure"], row["of"]) == ("accuracy", "all"))
    assert float(measured["share"]) == shares["all"].share > 0.97


def test_unusable_drives_are_rejected(drives, tmp_path):
    with pytest.raises(ValueError, match="must both be given"):
        Figure25(left=drives["left"])
    with pytest.raises(ValueError, match="pairs=1 must be at least 2"):
        Figure25(pairs=1)
    with pytest.raises(RecordingError, match="lacks the positions of its cones"):
        Figure25(drives["left"], drives["right"], both=drives["left"])
    with pytest.raises(UserError, match="are too few to learn from"):
        Figure25(drives["left"][:1], drives["right"]).make(tmp_path / "figure_25")


def test_a_recorded_drive_has_the_ground_truth_of_the_simulated_one(tmp_path):
    drive = simulated_drive("both", seed=7)
    save_drive(drive, tmp_path / "both.mcap")
    again = labelled_drive(read_recording(tmp_path / "both.mcap"))
    length = len(drive.seconds) - 1
    assert np.array_equal(again.ranges, drive.ranges[:length])
    assert (again.hit == drive.hit[:length]).float().mean() > 0.999
    assert (again.visibility - drive.visibility[:length]).abs().max() < 0.2
    assert (again.visibility - drive.visibility[:length]).abs().mean() < 1e-3
    assert np.array_equal(again.thick, drive.thick)


def drive_with_varying_scans(path, sides, seed):
    """Record a drive with 250 ranges in every second scan and 470 in the others."""
    drives = [simulated_drive(sides, seed, lidar=SimulatedLidar(beams)) for beams in (250, 470)]
    for number, drive in enumerate(drives):
        save_drive(drive, path.with_suffix(f".{number}"))
    contents = [
        read_messages(path.with_suffix(f".{n}"), {"/scan": SCAN, "/odom": ODOMETRY}) for n in (0, 1)
    ]
    with RecordingWriter(path) as writer:
        for name, entries in contents[0].notes.items():
            writer.describe(name, entries)
        for index in range(len(drives[0].seconds)):
            writer.copy(contents[index % 2].messages["/scan"][index])
            writer.copy(contents[0].messages["/odom"][index])
    return drives


@pytest.mark.slow
def test_each_scan_is_measured_by_its_own_bearings(tmp_path):
    drives = drive_with_varying_scans(tmp_path / "both.mcap", "both", 7)
    recording = read_recording(tmp_path / "both.mcap")
    varying = labelled_drive(recording)
    every_second = []
    for number, drive in enumerate(drives):
        scans, beams = slice(number, len(varying.ranges), 2), len(drive.angles)
        assert np.array_equal(varying.ranges[scans, :beams], drive.ranges[scans])
        assert (varying.hit[scans, :beams] == drive.hit[scans]).float().mean() > 0.999
        assert (varying.hit[scans, beams:] == -1).all()
        difference = varying.visibility[scans] - drive.visibility[scans]
        assert difference.abs().mean() < 1e-3
        scanned = (drive.ranges[number::2].numpy(), drive.angles.numpy())
        every_second.append(clusters_in_range([scanned])[0])
    features, _ = clusters_in_range([(recording.ranges, recording.angles(slice(None)))])
    expected = np.concatenate(every_second)
    np.testing.assert_allclose(np.sort(features, axis=0), np.sort(expected, axis=0), atol=1e-6)


def clusters(count=300, seed=0):
    rng = np.random.default_rng(seed)
    width = np.where(rng.random(count) < 0.5, 0.08, 0.035) + rng.normal(0, 0.006, count)
    reflection = 1.2 * width + rng.normal(0, 0.001, count)
    return np.stack([width, rng.uniform(0, 0.02, count), reflection], axis=1)


def test_components_are_the_eigenvectors_of_the_correlation_matrix_in_any_units():
    features = clusters()
    xy, directions, share = principal_components(features)
    values, vectors = np.linalg.eigh(np.corrcoef(features.T))
    np.testing.assert_allclose(share, values[::-1][:2] / 3)
    np.testing.assert_allclose(np.abs(directions), np.abs(vectors[:, ::-1][:, :2]), atol=1e-9)
    np.testing.assert_allclose(xy.var(axis=0), values[::-1][:2])
    np.testing.assert_allclose(xy.mean(axis=0), 0, atol=1e-12)
    assert (np.abs(directions).max(axis=0) == directions.max(axis=0)).all()
    np.testing.assert_allclose(principal_components(features * [1000, 1, 0.01])[0], xy, atol=1e-9)
