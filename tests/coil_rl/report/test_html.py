"""The report as one HTML file, also of run folders that somebody else made."""

import re
from html.parser import HTMLParser

import pytest
from run_folders import driven, make_run

from coil_rl.errors import UserError
from coil_rl.report import draw_learning_curves, page, style
from coil_rl.report.comparison import compare
from coil_rl.report.figures import draw_report, films
from coil_rl.report.html import SCRIPT, Section, embedded, html_page, svg
from coil_rl.report.runs import read_runs
from coil_rl.report.table import Table

EVIL = (
    "</td><script>alert(1)</script><img src=x onerror=alert(2)>"
    '" onload="alert(3)--><svg/onload=alert(4)>'
)
WEBP = b"RIFF\x00\x00\x00\x00WEBPVP8 "


class Reader(HTMLParser):
    """Collects the elements, their attributes and the texts of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.comments, self.texts, self.scripts = [], [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_comment(self, data):
        self.comments.append(data)

    def handle_data(self, data):
        (self.scripts if self.tags[-1:] == ["script"] else self.texts).append(data)


def report(folder):
    runs = read_runs([folder])
    compared = {"deterministic": compare(runs)}
    strokes = style.strong_strokes({run.label for run in runs})
    figures = draw_report(runs, compared, folder, strokes)
    blocks = page.section(compared["deterministic"], None)
    section = Section("Deterministic actions", blocks, figures)
    return html_page(f"Report of {folder.name}", [section])


@pytest.fixture(scope="module")
def evil(tmp_path_factory):
    """Return the report of a run whose every text is an attack."""
    folder = tmp_path_factory.mktemp("evil")
    rows = driven("guide", {EVIL: 1.0}) + driven(EVIL, {EVIL: 2.0})
    rows += driven(EVIL, {EVIL: 1.0}, advice=EVIL)
    run = make_run(folder / "run", EVIL, 0, rows)
    (run / "episode.webp").write_bytes(WEBP + EVIL.encode())
    return report(folder)


@pytest.mark.slow
def test_texts_of_run_folders_are_only_texts(evil):
    read = Reader(evil)
    assert [tag for tag in read.tags if tag in ("script", "img")] == ["img", "script"]
    assert "".join(read.scripts).strip() == SCRIPT.strip()
    assert not [name for name, _ in read.attributes if name.startswith("on")]
    assert not [comment for comment in read.comments if "alert" in comment]
    shown = "".join(read.texts)
    assert shown.count("alert(1)") > 3, "they are shown as they are"
    assert "Content-Security-Policy" in evil


def test_page_needs_nothing_else(evil):
    text = evil.replace("</", "").replace("/>", "")
    assert not re.findall(r"https?:|//[a-z]|@import|url\((?!#)", text)
    for name, value in Reader(evil).attributes:
        if name in ("src", "href", "data"):
            assert value.startswith(("#", "data:"))


def test_cells_carry_the_numbers_that_rows_are_sorted_by():
    rows = [
        {"name": "a", "score": 1.5, "interval": "1,031.2 (4 to 5)"},
        {"name": "b", "score": None, "interval": "-"},
    ]
    columns = {"name": ("name", ""), "score": ("score", ".1f"), "interval": ("interval", "")}
    table = Table(rows, columns)
    text = html_page("title", [Section("", [table, "a paragraph"])])
    assert re.findall(r'data-number="([^"]*)"', text) == ["1.5", "1031.2"]
    assert table.numeric == [False, True, False]
    assert "<p>a paragraph</p>" in text


def test_table_without_rows_is_its_headings():
    table = Table([], {"driver": ("who drives", "")})
    assert "who drives" in html_page("title", [Section("", [table])])
    assert "who drives" in table.latex()


def test_equal_pictures_are_equal_texts():
    runs = {"coil": [[{"frames": n, "evaluation/return": n} for n in range(3)]]}

    def draw(buffer):
        draw_learning_curves(runs, buffer)

    assert svg(draw) == svg(draw)
    assert svg(draw).startswith("<svg")
    assert ">coil<" in svg(draw), "letters are text"


def test_file_that_is_no_picture_is_refused(tmp_path):
    assert embedded(WEBP).startswith("data:image/webp;base64,")
    assert embedded(b"\x89PNG\r\n\x1a\n").startswith("data:image/png;base64,")
    assert embedded(b"GIF89a" + EVIL.encode()).startswith("data:image/gif;base64,")
    folder = make_run(tmp_path / "run", "coil", 0, driven("coil", {"a": 2.0}))
    (folder / "episode.webp").write_bytes(b"<svg onload=alert(1)>")
    with pytest.raises(UserError, match=r"episode.webp is damaged"):
        films(read_runs([tmp_path]))


def test_method_has_one_colour_in_all_pictures():
    names = ("coil", "ppo", "kickstart", "sac", "coil_anchored_sac")
    alone = {name: style.strong_strokes([name])[name] for name in names}
    together = style.strong_strokes(["mine", *reversed(names)])
    for name, stroke in alone.items():
        assert together[name] == stroke
        assert style.strokes(["guide", name])[name] == stroke
    assert len({stroke.colour for stroke in together.values()}) == len(together)


def test_variants_of_a_method_have_its_colour_and_other_dashes():
    labels = ["ppo 1", "ppo 2", "coil_anchored", "coil", "mine", "jump_start"]
    strokes = style.strong_strokes(labels)
    assert len(set(map(str, strokes.values()))) == len(labels)
    assert {strokes[label].colour for label in labels[:2]} == {style.OWN["ppo"].colour}
    for name in ("coil_anchored", "coil", "jump_start"):
        assert strokes[name] == style.OWN[name]
    many = style.strong_strokes([f"run {number}" for number in range(40)])
    assert len(set(map(str, list(many.values())[:20]))) == 20
