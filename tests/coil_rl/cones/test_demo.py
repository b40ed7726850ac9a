"""coil-demo: a picture from a shipped policy."""

import pytest
from PIL import Image
from programs import called


@pytest.mark.slow
def test_picture_shows_one_lap_and_the_program_says_what_comes_next(tmp_path):
    done = called("demo", "picture.png", cwd=tmp_path)
    assert Image.open(tmp_path / "picture.png").width >= 800
    lines = done.stdout.splitlines()
    assert "agent observes what the guide would do" in lines[1]
    assert lines[2].startswith("demo: guide alone: lap time 45.")
    assert lines[3].startswith("demo: agent with its advice: lap time 44.")
    assert "  coil-evaluate run=pretrained:cone_track/coil_anchored" in lines


@pytest.mark.parametrize("words", [["picture.gif"], ["a.png", "b.png"], ["folder=x"]])
def test_wrong_name_is_one_sentence(words, tmp_path):
    done = called("demo", *words, cwd=tmp_path, code=2)
    said = f"demo: {' '.join(words)} is not the name of one picture, which ends with .png; give"
    assert said in done.stderr
    assert not list(tmp_path.iterdir())
