"""One text means one folder in `run=`, which Hydra reads, and in `resume=`, which it does not."""

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from coil_rl.programs.folders import folder, spelled

NAMES = [
    "a b",
    "a=b",
    "\u00fc",
    "a'b",
    'a"b',
    "a,b",
    "[x]",
    "a(1)",
    "tail\\",
    "a{b}",
    "a#b",
    "null",
]
NAMES += ["2024", "a: b", "$x", "a\\'b", "'q'", " lead", "~", "a\\\\", "{}", "1e3", "true"]


def by_hydra(text):
    return str(OverridesParser.create().parse_override(spelled(f"run={text}")).value())


@pytest.mark.parametrize("name", NAMES)
def test_existing_folder_is_found_by_its_name(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / name).mkdir(exist_ok=True)
    expected = tmp_path if name == "~" else tmp_path / name
    assert (tmp_path / folder(name)).samefile(expected)
    assert (tmp_path / by_hydra(name)).samefile(expected)


def test_folder_of_a_report_has_the_same_spellings_and_may_be_a_list(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in NAMES:
        (tmp_path / name).mkdir(exist_ok=True)
        read = OverridesParser.create().parse_override(spelled(f"folder={name}"))
        assert (tmp_path / read.value()).samefile(tmp_path / folder(name))
    for text in ("[one,other]", "['a b','c,d']"):
        assert spelled(f"folder={text}") == f"folder={text}"


@pytest.mark.parametrize("text", ["'a=b'", '"a=b"', "a=b", "~/x", "'a b'", "~nobody/x", "x" * 300])
def test_quotes_of_hydra_may_be_around_a_name(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert by_hydra(text) == str(folder(text))
    assert folder(text).name == text.strip("'\"").rpartition("/")[2]


@pytest.mark.parametrize(
    "argument", ["seed=0", "run", "-m", "run=null", "run=a,b", "run=[a]", "run=${seed}", "=", ""]
)
def test_other_arguments_stay_as_they_are(argument):
    assert spelled(argument) == argument
