"""docs/methods has all methods, and commands that compose.

The options are named with their defaults.
"""

import json
import re
import shlex
from itertools import chain

import pytest
from omegaconf import OmegaConf
from programs import ROOT, composed, shipped

FOLDER = ROOT / "docs" / "methods"
PAGES = sorted(FOLDER.glob("*.md"))


def commands(page):
    text = page.read_text().replace("\\\n", "")  # a command of several lines
    lines = re.findall(r"^ *(coil-\w+ .*)$|`(coil-\w+ [^`]+)`", text, flags=re.MULTILINE)
    return [shlex.split(block or inline, comments=True) for block, inline in lines]


COMMANDS = [(page, command) for page in PAGES for command in commands(page)]
FIRST = {page: command for page, command in reversed(COMMANDS)}
OTHER = [command for page, command in COMMANDS if command is not FIRST[page]]


def table(page, *headings):
    """Return the cells of the rows of those tables whose first columns have some headings."""
    head = r" \| ".join(headings)
    tables = re.findall(
        rf"^\| {head} \|.*\n\|[-| ]+\n((?:\|.*\n)+)", page.read_text(), flags=re.MULTILINE
    )
    rows = chain.from_iterable(rows.splitlines() for rows in tables)
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]


INDEX = {
    re.search(r"`(\w+)`", name)[1]: cells
    for name, *cells in table(FOLDER / "README.md", "method", "idea")
}


def configured(command):
    """Return the configuration of a command; its method, if it has one, must be in the index."""
    program, *overrides = command
    if "-m" in overrides:  # the first run of the sweep
        overrides = [override.partition(",")[0] for override in overrides if override != "-m"]
    config = composed(*overrides, name=program.removeprefix("coil-"))
    if "method" in config:
        assert INDEX[config.method.name][1].startswith("yes" if config.method.needs_guide else "no")
    return config


def shown(value):
    """Return a value of a configuration as the pages print it."""
    if OmegaConf.is_dict(value) and value["_target_"] == "coil_rl.schedules.Linear":
        points = [f", {key} {value[key]:g}" for key in ("since", "until") if key in value]
        return "".join([f"{value.start:g} to {value.end:g}", *points])
    if OmegaConf.is_list(value):
        return json.dumps(OmegaConf.to_container(value))
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return f"{value:g}" if is_number else json.dumps(value).strip('"')


def test_every_method_has_a_row_in_the_index_and_every_page_a_link():
    assert set(shipped("method")) <= set(INDEX)
    linked = re.findall(r"\]\((\w+\.md)\)", (FOLDER / "README.md").read_text())
    assert {page.name for page in PAGES} - {"README.md"} == set(linked)


@pytest.mark.fast(6)
@pytest.mark.parametrize("page", FIRST, ids=[page.stem for page in FIRST])
def test_first_command_of_a_page_composes_and_has_its_options_and_defaults(page):
    config = configured(FIRST[page])
    for option, default, _ in table(page, "option", "default"):
        assert shown(OmegaConf.select(config, option.strip("`"))) == default, option


@pytest.mark.slow
@pytest.mark.parametrize("command", OTHER, ids=[" ".join(command) for command in OTHER])
def test_other_commands_of_the_pages_compose(command):
    configured(command)
