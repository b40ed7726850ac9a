from pathlib import Path

import pytest
from programs import called


@pytest.fixture(autouse=True)
def here(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


def outcome(*arguments):
    """Exit code, and what stands on standard output and error."""
    done = called("reproduce", *arguments, code=None)
    return done.returncode, done.stdout, done.stderr


def test_results_leave_their_pages_numbers_and_pictures_and_print_the_pages():
    code, out, _ = outcome("table=1", "figure=6", "hydra.run.dir=run")
    files = {path.name for path in Path("run").iterdir()} - {".hydra"}
    assert code == 0
    assert files == {f"{name}.{ending}" for name in ("table_1", "figure_6") for ending in ("md", "csv", "png")}
    pages = [Path("run", f"{name}.md").read_text() for name in ("table_1", "figure_6")]
    assert out == f"{pages[0]}\n{pages[1]}\nreproduce: table_1, figure_6 made; see {Path('run').absolute()}\n"


def test_a_choice_of_a_result_reaches_it():
    assert outcome("figure=6", "results.figure_6.iterations=7", "hydra.run.dir=run")[0] == 0
    assert len(Path("run/figure_6.csv").read_text().splitlines()) == 1 + 8


def test_a_folder_with_the_result_is_not_written_to_again():
    assert outcome("table=1", "hydra.run.dir=run")[0] == 0
    code, _, error = outcome("table=1", "hydra.run.dir=run")
    assert code == 2
    assert "already holds table_1; choose another folder with hydra.run.dir=FOLDER" in error


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "nothing is asked for; give one of table=1, figure=6"),
        ("table=3", "table=3 cannot be made; there are table=1, figure=6"),
        ("claim=table_1", "claim=table_1 cannot be made"),
        ("table=one", "table='one' must be a whole number or null"),
        ("tabel=1", "there is no key tabel"),
        ("+other=1", "there is no key other"),
        ("table=1 results.table_1.tolerance=0", "results.table_1: tolerance=0 must be more than 0"),
        ("table=1 +results.table_1.x=0", "results.table_1: Table1 takes no x; it takes tolerance"),
        ("table=1 results.table_1._target_=builtins.dict results.table_1.tolerance=1", "but Result is wanted"),
    ],
)
def test_a_mistake_is_one_sentence_and_leaves_nothing(arguments, words):
    code, _, error = outcome(*arguments.split())
    assert code == 2
    assert len(error.splitlines()) == 1
    assert words in error
    assert not list(Path().iterdir())
