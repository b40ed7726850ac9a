import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.parametrize(
    "example", EXAMPLES, ids=["cone world", "own env", "gymnasium", "recording"]
)
def test_examples_run_as_printed(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found: dict = {}
    exec(compile(example, "README.md", "exec"), found)
    if "batch" in found:
        assert found["batch"]["guide_action"].shape == (64, 100, 1, 1)
    if "steps" in found:
        assert found["steps"]["cone_count"].sum() > 200


def test_commands_exist():
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"(?:^|`)make ([a-z-]+)", README, flags=re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target
    scripts = (ROOT / "pyproject.toml").read_text()
    for program in set(re.findall(r"^(coil-[a-z]+)", README, flags=re.MULTILINE)) - {"coil-rl"}:
        assert f"{program} = " in scripts, program


def test_files_and_pictures_that_are_linked_are_there():
    for link in re.findall(r"\]\((?!https)([^)]+)\)", README):
        assert (ROOT / link).is_file(), link
