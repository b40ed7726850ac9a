"""The site: built without a warning, complete in itself, with right signatures."""

import html
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from programs import ROOT

pytestmark = pytest.mark.slow
LOADED = r'<(?:script|img|iframe|source)\b[^>]*\bsrc="([^"]*)"|<link\b[^>]*\bhref="([^"]*)"'


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build the site; a warning is an error."""
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-c", "docs", "-b", "html"]
    skip = ["-D", "nb_execution_mode=off"]  # notebooks have a test of their own
    done = subprocess.run(
        [*build, *skip, ".", str(folder)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


def text_of(page: Path) -> str:
    return html.unescape(re.sub(r"<[^>]+>", "", page.read_text()))


def test_nothing_is_loaded_from_elsewhere(site):
    pages = [*site.rglob("*.html")]
    assert len(pages) > 40
    for page in pages:
        for source, link in re.findall(LOADED, page.read_text()):
            assert not re.match(r"(https?:)?//", source or link), page
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//|@import", sheet.read_text()), sheet


def test_an_env_is_shown_with_the_arguments_of_its_constructor(site):
    text = text_of(site / "docs" / "api.html")
    assert re.search(r"class coil_rl\.ConeTrackEnv\(\s*tracks: ", text)
    assert not re.search(r"class coil_rl\.\w+\(\s*\*args,\s*\*\*kwargs", text)


def test_commands_and_choices_are_those_of_the_code(site):
    commands = text_of(site / "docs" / "commands.html")
    assert "coil-train: train a method, evaluate the policy beside its guides" in commands
    choices = text_of(site / "docs" / "configuration.html")
    for file in (ROOT / "conf" / "method").glob("*.yaml"):
        assert f"conf/method/{file.name}" in choices


def test_arguments_that_a_class_above_documents_are_on_the_page(site):
    text = text_of(site / "docs" / "api.html")
    shown = re.search(r"class coil_rl\.learners\.Gru\(.*?(?=class coil_rl)", text, flags=re.DOTALL)
    assert "tanh, relu, elu or silu" in shown[0]
