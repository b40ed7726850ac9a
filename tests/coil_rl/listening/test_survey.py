import pytest
import torch
from ovals import oval_track
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from coil_rl.envs import ConeTrackEnv
from coil_rl.guides import RandomGuide, SplineGuide
from coil_rl.listening import PLACES, Ablation, Places, ablations, drive_ablated, survey
from coil_rl.listening.survey import guide_names
from coil_rl.listening.tables import along, along_lines, by_place
from coil_rl.transforms import GuideActions

TRACKS = [oval_track("to the left"), oval_track("to the right", clockwise=True)]
NAMES = [track.name for track in TRACKS]
PLACE = Places(TRACKS)
FOLLOW = TensorDictModule(lambda advice: advice[:, 0], in_keys=["guide_action"], out_keys=["action"])


def world(cars, seconds=60):
    env = ConeTrackEnv(TRACKS, cars, rate=6, laps=1, time_limit=seconds, assignment="cyclic")
    return TransformedEnv(env, GuideActions({"spline": SplineGuide(), "random": RandomGuide()}))


@pytest.fixture(scope="module")
def found():
    return survey(world(4), FOLLOW, PLACE, donors=4, names=NAMES)


@pytest.fixture(scope="module")
def ablated(found):
    removed = ablations(2)
    episodes = drive_ablated(world(2 * len(removed)), FOLLOW, PLACE, removed, found.advice.mean(0), names=NAMES)
    return dict(zip(removed, episodes, strict=True))


def test_every_state_of_every_drive_is_measured(found):
    assert found.guides == ["spline", "random"]
    assert all(episode["completed"] for episode in found.drive.episodes)
    count = sum(episode["steps"] for episode in found.drive.episodes)
    assert found.advice.shape == (count, 2, 1)
    assert all(values.shape == (count, 2) for values in found.measures.values())
    # All cars of a track come round it once.
    for index, line in enumerate(PLACE.lines):
        assert len(found.point[found.track == index].unique()) > 0.7 * len(line)


def test_a_follower_of_the_first_guide_is_deaf_to_the_second(found):
    means = {name: values.mean(0).tolist() for name, values in found.measures.items()}
    assert means["agreement"][0] == 0
    assert means["agreement"][1] > 0.4
    assert means["intervention"][0] > 0.05
    assert means["intervention"][1] == 0
    assert means["gradient"] == [1, 0]


def test_the_same_seed_draws_the_same_donors():
    moved = [survey(world(4, 4), FOLLOW, PLACE, donors=4, seed=seed).measures["intervention"] for seed in (0, 0, 1)]
    assert (moved[0] == moved[1]).all()
    assert (moved[0] != moved[2]).any()


def test_silence_of_a_guide_nobody_listens_to_costs_nothing_and_that_of_the_other_the_lap(found, ablated):
    rows = {(row["guide"], row["place"]): row for row in by_place(found, PLACE, ablated)}
    for (guide, _), row in rows.items():
        if guide == "random":
            assert row["lost"] == pytest.approx(0, abs=1e-3)
            assert row["completed"] == 1
    assert rows["spline", "everywhere"]["completed"] == 0
    assert rows["spline", "everywhere"]["lost"] > 100


def test_a_guide_is_silent_at_its_places_only():
    heard = []

    def note(advice, pose, track):
        heard.append((PLACE.kind(track.squeeze(-1), pose[:, :2]), advice[:, 0, 0]))
        return advice[:, 1]

    keys = ["guide_action", ("info", "pose"), ("info", "track")]
    agent = TensorDictModule(note, in_keys=keys, out_keys=["action"])
    env = ConeTrackEnv(TRACKS, 4, rate=6, laps=1, time_limit=15, assignment="cyclic")
    env = TransformedEnv(env, GuideActions({"told": RandomGuide(0.5, 1.0), "spline": SplineGuide()}))
    left = PLACES.index("left")
    drive_ablated(env, agent, PLACE, [Ablation(0, left), Ablation(0)], torch.tensor([[0.25], [0.0]]), names=NAMES)
    kind, said = (torch.stack(column) for column in zip(*heard, strict=True))
    assert ((said[:, :2] == 0.25) == (kind[:, :2] == left)).all()
    assert (kind[:, :2] == left).any()
    assert (said[:, 2:] == 0.25).all()


def test_rows_by_place_add_up_to_everywhere(found, ablated):
    rows = by_place(found, PLACE, ablated)
    for guide in found.guides:
        whole, *parts = [row for row in rows if row["guide"] == guide]
        assert whole["place"] == "everywhere"
        assert sum(row["share"] for row in parts) == pytest.approx(1)
        for measure in found.measures:
            assert sum(row["share"] * row[measure] for row in parts) == pytest.approx(whole[measure], abs=1e-6)


def test_rows_along_the_tracks_hold_every_state_once(found):
    rows = along(found, PLACE, bin_length=2.0)
    for guide in found.guides:
        mine = [row for row in rows if row["guide"] == guide]
        assert sum(row["states"] for row in mine) == len(found.track)
        for measure in found.measures:
            slot = found.guides.index(guide)
            total = sum(row["states"] * row[measure] for row in mine)
            assert total == pytest.approx(float(found.measures[measure][:, slot].sum()), rel=1e-4)
    for index, line in enumerate(PLACE.lines):
        starts = [row["from"] for row in rows if row["track"] == NAMES[index] and row["guide"] == "spline"]
        assert starts == sorted(starts)
        assert len(starts) <= len(line)
        assert starts[-1] == pytest.approx(TRACKS[index].length, abs=6)


def test_lines_carry_the_numbers_of_the_rows(found):
    lines, values = along_lines(found, PLACE, "agreement", bin_length=2.0)
    assert [len(line) for line in lines] == [len(row) for row in values["random"]]
    assert all((row == 0).all() for row in values["spline"])
    rows = {row["agreement"] for row in along(found, PLACE, bin_length=2.0) if row["guide"] == "random"}
    assert set(values["random"][0].tolist()) <= rows


def test_cars_must_be_shared_out_evenly():
    with pytest.raises(ValueError, match="4 cars cannot be shared out to 3 ablations"):
        drive_ablated(world(4), FOLLOW, PLACE, ablations(2)[:3], torch.zeros(2, 1))


def test_names_come_from_whoever_gives_the_advice():
    assert guide_names(world(2), FOLLOW) == ["spline", "random"]
    with pytest.raises(ValueError, match="nobody gives the policy its advice"):
        guide_names(ConeTrackEnv(TRACKS, 2), FOLLOW)
