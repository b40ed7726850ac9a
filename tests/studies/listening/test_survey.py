import pytest
import torch
from ovals import oval_track
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from worlds import acting, driving_measures

from coil_rl.envs import ConeTrackEnv, SimulatedRobotEnv
from coil_rl.guides import RandomGuide, SplineGuide
from coil_rl.run.judge import Evaluation
from coil_rl.transforms import GuideActions
from coil_studies.listening.sections import SECTIONS, TrackSections, WholeEpisode
from coil_studies.listening.survey import (
    Ablation,
    ablations,
    drive_ablated,
    survey,
    table_by_section,
)

TRACKS = [oval_track("to the left"), oval_track("to the right", clockwise=True)]
TRACK_SECTIONS = TrackSections(TRACKS)
EVALUATION = Evaluation(
    [track.name for track in TRACKS], driving_measures(), {"pose": ("info", "pose")}
)


def follow(slot):
    """Return a policy that does what a guide says."""
    return acting(lambda advice: advice[:, slot], "guide_action")


FOLLOW = follow(0)


def cars(count, seconds=60):
    return ConeTrackEnv(TRACKS, count, rate=6, laps=1, time_limit=seconds, assignment="cyclic")


def guided(env):
    return TransformedEnv(env, GuideActions({"spline": SplineGuide(), "random": RandomGuide()}))


@pytest.fixture(scope="module")
def found():
    return survey(guided(cars(4)), FOLLOW, TRACK_SECTIONS, EVALUATION, donors=4)


@pytest.fixture(scope="module")
def rows(found):
    removed = ablations(2, len(SECTIONS))
    env = guided(cars(2 * len(removed)))
    episodes = drive_ablated(env, FOLLOW, TRACK_SECTIONS, EVALUATION, removed, found.advice.mean(0))
    return table_by_section(
        found, TRACK_SECTIONS, EVALUATION, dict(zip(removed, episodes, strict=True))
    )


@pytest.mark.slow
def test_every_state_of_every_episode_has_its_section(found):
    assert all(episode["completed"] for episode in found.result.episodes)
    count = sum(episode["steps"] for episode in found.result.episodes)
    assert found.advice.shape == (count, 2, 1)
    assert all(values.shape == (count, 2) for values in found.measures.values())
    for index, line in enumerate(TRACK_SECTIONS.lines):
        on_track = found.place["track"] == index
        points = found.place["point"][on_track]
        assert len(set(points)) > 0.7 * len(line)
        assert (found.section[on_track] == TRACK_SECTIONS.sections[index][points]).all()


@pytest.mark.slow
def test_advice_is_replaced_in_its_section_only():
    history = []

    def act(advice, pose, track):
        place = TRACK_SECTIONS.locate(
            TensorDict({"info": {"track": track, "pose": pose}}, pose.shape[:1])
        )
        history.append((TRACK_SECTIONS.section(place), advice[:, 0, 0]))
        return advice[:, 1]

    keys = ["guide_action", ("info", "pose"), ("info", "track")]
    agent = acting(act, *keys)
    guides = {"noise": RandomGuide(0.5, 1.0), "spline": SplineGuide()}
    env = TransformedEnv(cars(4, seconds=15), GuideActions(guides))
    left, replacement = SECTIONS.index("left"), torch.tensor([[0.25], [0.0]])
    removed = [Ablation(0, left), Ablation(0)]
    drive_ablated(env, agent, TRACK_SECTIONS, EVALUATION, removed, replacement)
    section, advice = (torch.stack(column) for column in zip(*history, strict=True))
    assert ((advice[:, :2] == 0.25) == (section[:, :2] == left)).all()
    assert (section[:, :2] == left).any()
    assert (advice[:, 2:] == 0.25).all()


@pytest.mark.slow
def test_rows_by_section_add_up_to_the_first_one(found, rows):
    for guide in found.guides:
        everywhere, *parts = [row for row in rows if row["guide"] == guide]
        assert everywhere["section"] == "everywhere"
        assert sum(row["share"] for row in parts) == pytest.approx(1)
        for measure in found.measures:
            whole = sum(row["share"] * row[measure] for row in parts)
            assert whole == pytest.approx(everywhere[measure], abs=1e-6)
        if guide == "random":  # which is not followed
            for row in (everywhere, *parts):
                assert (row["completed"], row["lost"]) == (1, pytest.approx(0, abs=1e-3))
        else:
            assert (everywhere["completed"], everywhere["lost"] > 100) == (0, True)


@pytest.mark.slow
def test_rows_along_the_track_contain_every_state_once(found):
    sections = TrackSections(TRACKS, bin=2.0)
    rows = sections.table(found)
    for slot, guide in enumerate(found.guides):
        of_guide = [row for row in rows if row["guide"] == guide]
        assert sum(row["states"] for row in of_guide) == len(found.section)
        for measure in found.measures:
            total = sum(row["states"] * row[measure] for row in of_guide)
            assert total == pytest.approx(float(found.measures[measure][:, slot].sum()), rel=1e-4)
    lines, values = sections.measure_on_lines(found, rows, "agreement")
    assert [len(line) for line in lines] == [len(row) for row in values["random"]]
    assert set(values["random"][0].tolist()) <= {
        row["agreement"] for row in rows if row["guide"] == "random"
    }


def robots(count):
    return SimulatedRobotEnv(num_envs=count, assignment="cyclic", laps=1, time_limit=20)


@pytest.mark.fast(1)
@pytest.mark.parametrize(("bare", "slot"), [(cars, 1), (robots, 0)], ids=["cars", "robots"])
def test_removal_of_a_guide_that_is_not_followed_loses_nothing(bare, slot):
    """All draws, of a random guide and of a LiDAR, are the same with and without the removal."""
    policy, evaluation, sections = follow(slot), Evaluation(["the track"]), WholeEpisode()
    intact = survey(guided(bare(3)), policy, sections, evaluation, donors=1)
    returns = [episode["reward"] for episode in intact.result.episodes]
    removed, zero = [Ablation(1 - slot), Ablation(slot)], torch.zeros(2, 1)
    env = guided(bare(6))
    unused, used = drive_ablated(env, policy, sections, evaluation, removed, zero)
    assert len(set(returns)) == 3
    assert [episode["reward"] for episode in unused] == pytest.approx(returns, rel=1e-6)
    assert [episode["reward"] for episode in used] != pytest.approx(returns, rel=1e-6)
