"""Test of what a program shows: a fault in it does not end the work."""

import io
import sys

import pytest

from coil_rl import output
from coil_rl.output import SafeStream, decoration, progress, quietly, say
from coil_rl.run.metrics import Metrics


class Closed(io.StringIO):
    """A stream whose terminal was closed."""

    def write(self, text):
        raise BrokenPipeError


def closed_file():
    stream = io.StringIO()
    stream.close()
    return stream


@pytest.mark.parametrize("make", [lambda: None, Closed, closed_file])
def test_bars_and_texts_need_no_stream(monkeypatch, make):
    monkeypatch.setattr(sys, "stderr", make())
    monkeypatch.setattr(sys, "stdout", make())
    with progress(total=3, mininterval=0) as bar:
        for _ in range(3):
            bar.update()
            bar.set_postfix({"training": "1"})
    say("a text")
    say("an error", error=True)
    with decoration("the picture"):
        raise ValueError("no frames")


def test_stream_is_written_to_until_it_breaks():
    stream = io.StringIO()
    safe = SafeStream(stream)
    assert safe.write("text") == 4
    assert stream.getvalue() == "text"
    assert not safe.broken
    assert safe.encoding == stream.encoding
    stream.close()
    assert safe.write("more") == 4
    assert safe.broken


@pytest.mark.parametrize("error", [ValueError("bad"), TypeError("floats"), OSError(28, "full")])
def test_fault_in_a_decoration_is_a_warning_of_one_sentence(error):
    left_out = pytest.warns(UserWarning, match=r"the picture is left out \(.*\); the results")
    with left_out as caught, decoration("the picture"):
        raise error
    assert "\n" not in str(caught[0].message)


def test_interrupt_is_no_fault():
    with pytest.raises(KeyboardInterrupt), decoration("the picture"):
        raise KeyboardInterrupt


def test_logger_that_fails_is_left_out(tmp_path):
    class Logger:
        calls = 0

        def log_scalar(self, name, value, step):
            self.calls += 1
            raise ConnectionError("no network")

    logger = Logger()
    metrics = Metrics(tmp_path / "metrics.csv", logger)
    with pytest.warns(UserWarning, match="the logger Logger of .* is left out"):
        metrics.append({"frames": 1.0, "a": 2.0})
    metrics.append({"frames": 2.0, "a": 3.0})
    metrics.flush()
    assert logger.calls == 1
    assert len((tmp_path / "metrics.csv").read_text().splitlines()) == 3


def test_bars_may_be_shown_where_nothing_is_said(capsys):
    with quietly(bars=True):
        say("said")
        with quietly():
            progress(total=1).close()
            say("an error", error=True)
        assert capsys.readouterr() == ("", "")
        progress(total=1).close()
        with quietly(bars=True):
            say("said")
    out, error = capsys.readouterr()
    assert (out, "0/1" in error) == ("", True)
    say("a text")
    assert capsys.readouterr().out == "a text\n"


def test_bar_in_a_file_is_a_line_now_and_then(monkeypatch, capsys):
    monkeypatch.setattr(output, "LINE_EVERY", 0.0)
    with progress(total=2, desc="train") as bar, progress(desc="test", leave=False) as inner:
        bar.set_postfix(training="1")
        inner.update()
    monkeypatch.setattr(output, "LINE_EVERY", 60.0)
    with progress(total=3, desc="quiet") as bar, progress(desc="test", leave=False) as inner:
        for _ in range(3):
            bar.update()
            inner.update()
    error = capsys.readouterr().err
    lines = error.splitlines()
    assert not {"\r", "\x1b"} & {*error}
    assert [line.partition(":")[0] for line in lines] == ["train", "test", "train", "quiet"]
    assert lines[-1].startswith("quiet: 100%")
