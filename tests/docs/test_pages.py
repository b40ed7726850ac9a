"""The README and the pages: links lead somewhere, code runs, programs exist, the index has all."""

import re
import subprocess
import sys
import tomllib
from functools import cache

import pandas
import pytest
from programs import ROOT, code_blocks, environment

DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.rglob("*.md"), *(ROOT / "paper").rglob("*.md"), *ROOT.glob("*.md")])
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]
# Their blocks with a word need nothing but the installation, and run one after the other.
EXECUTED = {
    "python.md": "import",
    "robot.md": "from coil_rl.envs",
    "coil.md": "import",
    "export.md": "pretrained",
}
# Of the table of methods with replay: its columns, two a task, and the methods of its rows.
TASKS = ["pendulum", "mountain_car", "serial_inventory", "energy_microgrid"]
REPLAY = {
    "coil_anchored": "coil_anchored_sac",
    "coil": "coil_sac",
    "ibrl": "ibrl",
    "cheq": "cheq_sac",
    "residual": "residual_sac",
    "SAC alone": "sac",
    "CrossQ alone": "crossq",
    "tune": "tune",
}


@cache
def text_without_code(page):
    return re.sub(r"^```.*?^```|`[^`\n]*`", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def code_of(page):
    """Return the blocks of a page, and what is code in its lines, a line each."""
    inline = re.findall(r"`([^`\n]+)`", page.read_text())
    return "\n".join([*(block for _, block in code_blocks(page)), *inline])


@cache
def anchors(page):
    """Return the anchors of the headings of a page, also of those that the build makes."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), flags=re.MULTILINE)
    if page == DOCS / "configuration.md":
        headings += [folder.name for folder in (ROOT / "conf").iterdir() if folder.is_dir()]
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_and_anchors_lead_somewhere(page):
    for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text_without_code(page)):
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.is_file(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_programs_and_targets_of_make_exist(page):
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    makefile = (ROOT / "Makefile").read_text()
    code = code_of(page)
    assert {*re.findall(r"^(coil-[a-z]+)(?: |$)", code, flags=re.MULTILINE)} <= {*scripts}
    for target in re.findall(r"^make ([a-z-]+)", code, flags=re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


def test_installation_names_the_extras_and_the_wheel():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    code = code_of(DOCS / "install.md")
    assert {*project["optional-dependencies"]} <= {*code.splitlines()}
    assert f"coil_rl-{project['version']}-py3-none-any.whl[" in code


def in_contents(page):
    """Yield the pages of the tables of contents of a page."""
    trees = re.findall(r"^```\{toctree\}\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.M)
    entries = [line for tree in trees for line in tree.splitlines() if line[:1] not in ("", ":")]
    for entry in entries:
        folder = page.parent
        while entry.startswith("../"):
            entry, folder = entry.removeprefix("../"), folder.parent
        yield from folder.glob(f"{entry.removesuffix('*')}{'*' * entry.endswith('*')}.md")


def test_every_page_is_in_the_contents():
    found = {each for page in PAGES for each in in_contents(page)}
    outside = {ROOT / "README.md", DOCS / "index.md"}
    assert {page for page in PAGES if page.parent != ROOT} - found - outside == set()


def python_blocks(name, word):
    """Return the blocks of Python of a page that have a word."""
    blocks = [block for language, block in code_blocks(DOCS / name) if language == "python"]
    return [block for block in blocks if word in block]


@pytest.mark.slow
@pytest.mark.parametrize("name", EXECUTED)
def test_code_runs_as_printed(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = python_blocks(name, EXECUTED[name])
    assert blocks
    found: dict = {}
    for block in blocks:
        exec(compile(block, name, "exec"), found)
    if name == "robot.md":
        assert found["steps"]["cone_count"].sum() > 200


@pytest.mark.slow
def test_distributed_collector_runs_a_learner(tmp_path):
    (block,) = python_blocks("python.md", "DistributedCollector")
    file = tmp_path / "distributed_coil.py"  # a file, which each process imports again
    file.write_text(block)
    command, options = [sys.executable, file], {"capture_output": True, "text": True}
    done = subprocess.run(command, env=environment(tmp_path), timeout=600, check=True, **options)
    updates = [line.split(":")[0] for line in done.stdout.splitlines()]
    assert updates == [f"update {number}" for number in range(4)]


def test_returns_of_methods_with_replay_are_those_of_the_runs():
    files = [DOCS / "methods" / f"{name}_runs.csv" for name in ("replay", "promise_sac")]
    runs = pandas.concat(map(pandas.read_csv, files))
    means = runs[runs["seed"] < 10].groupby(["task", "method", "arm"])["end"].mean()
    part = (DOCS / "learners.md").read_text().partition("### With a guide")[2]
    for name, method in REPLAY.items():
        [cells] = re.findall(rf"^\| \[?{name}\b[^|]*\|(.*)\|$", part, flags=re.MULTILINE)
        for place, shown in enumerate(cells.split("|")):
            if shown.strip():
                arm = "alone" if name.endswith("alone") else ("intact", "reversed")[place % 2]
                digits = len(shown.strip().partition(".")[2])
                mean = means[TASKS[place // 2], method, arm]
                assert float(shown) == round(mean, digits), (name, place)
