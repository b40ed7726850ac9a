"""Surveys of an env without sections."""

import numpy as np
import pytest
import torch
from programs import read_csv
from torchrl.envs import TransformedEnv
from worlds import Script, acting

from coil_rl.run.judge import Evaluation
from coil_rl.transforms import GuideActions
from coil_studies.listening import WholeEpisode
from coil_studies.listening.survey import (
    Ablation,
    ablations,
    drive_ablated,
    survey,
    table_by_section,
)

LENGTHS = [250, 3, 7, 120]
SECTIONS = WholeEpisode()
EVALUATION = Evaluation(["a", "b"], {}, {})
FOLLOW = acting(lambda advice: advice[:, 0], "guide_action")
CHOOSE = acting(lambda advice: (advice[:, 0] > 0).to(advice.dtype), "guide_action")
FILES = {"listening.csv", "listening.png", "listening_agreement.png", "listening_gradient.png"}


def world(copies=1):
    """Episodes of LENGTHS, with a guide that shows the time and one that does the opposite."""
    lengths = torch.tensor(LENGTHS * copies)
    time = torch.linspace(-1, 1, 256)[:, None, None].repeat(1, len(lengths), 1)
    guides = {
        "time": acting(lambda seen: seen.clone(), "time"),
        "opposite": acting(lambda seen: -seen, "time"),
    }
    return TransformedEnv(Script(lengths, torch.ones_like(time), time=time), GuideActions(guides))


@pytest.fixture(scope="module")
def found():
    return survey(world(), FOLLOW, SECTIONS, EVALUATION, donors=2)


def test_every_state_is_measured_in_no_section(found):
    assert found.guides == ["time", "opposite"]
    assert [episode["case"] for episode in found.result.episodes] == ["a", "b", "a", "b"]
    assert [episode["steps"] for episode in found.result.episodes] == LENGTHS
    assert np.bincount(found.step).tolist() == [4] * 3 + [3] * 4 + [2] * 113 + [1] * 130
    assert (np.diff(found.step) >= 0).all()
    assert (found.section == 0).all()
    assert found.section.shape == found.step.shape
    assert found.place == {}
    np.testing.assert_allclose(found.measures["agreement"][:, 0], 0)
    np.testing.assert_allclose(found.measures["gradient"], [[1, 0]] * sum(LENGTHS))


def test_pictures_and_numbers_are_along_the_steps(found, tmp_path):
    SECTIONS.draw(found, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == FILES
    rows = read_csv(tmp_path / "listening.csv")
    assert [row["guide"] for row in rows] == [name for name in found.guides for _ in range(84)]
    for slot, guide in enumerate(found.guides):
        own = [row for row in rows if row["guide"] == guide]
        assert [int(row["from"]) for row in own] == list(range(0, 250, 3)), (
            "at most 100 points, of whole steps"
        )
        for row in own:
            within = (found.step >= int(row["from"])) & (found.step < int(row["from"]) + 3)
            assert int(row["states"]) == within.sum()
            for measure, values in found.measures.items():
                assert float(row[measure]) == pytest.approx(values[within, slot].mean())


def test_discrete_actions_have_no_picture_of_a_gradient(tmp_path):
    SECTIONS.draw(survey(world(), CHOOSE, SECTIONS, EVALUATION, donors=2), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == FILES - {"listening_gradient.png"}


def test_guides_are_removed_everywhere_only(found):
    seen = []

    def act(advice):
        seen.append(advice)
        return advice[:, 0]

    removed = ablations(2, len(SECTIONS.names))
    assert removed == [Ablation(0), Ablation(1)]
    agent, advised = acting(act, "guide_action"), torch.tensor([[0.25], [0.5]])
    episodes = drive_ablated(world(2), agent, SECTIONS, EVALUATION, removed, advised)
    advice = torch.stack(seen).squeeze(-1)
    assert (advice[:, :4, 0] == 0.25).all()
    assert (advice[:, 4:, 1] == 0.5).all()
    assert (advice[:, 4:, 0] == -advice[:, :4, 1]).all()

    rows = table_by_section(found, SECTIONS, EVALUATION, dict(zip(removed, episodes, strict=True)))
    assert [(row["guide"], row["section"], row["share"], row["lost"]) for row in rows] == [
        ("time", "everywhere", 1, 0),
        ("opposite", "everywhere", 1, 0),
    ]
    assert all("completed" not in row for row in rows)
    for slot, row in enumerate(rows):
        for measure, values in found.measures.items():
            assert row[measure] == pytest.approx(values[:, slot].mean())
