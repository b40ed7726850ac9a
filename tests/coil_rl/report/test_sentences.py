"""Sentences of pages from their templates."""

import pytest
from jinja2 import UndefinedError

from coil_rl.report.sentences import REPORT, listed, returns


def test_text_of_a_run_is_no_template():
    (said,) = REPORT.said("begun", labels={"{{ 1 + 1 }}": ["<b> & {% x %}"]})
    assert said.startswith("Runs of {{ 1 + 1 }} began with <b> & {% x %}, whose frames")


def test_value_that_is_not_given_is_an_error():
    with pytest.raises(UndefinedError):
        REPORT.said("progress", finished=2)


def test_many_texts_are_shortened_and_returns_share_their_digits():
    assert listed("abcd") == "a, b, c, d"
    assert listed("abcde", joint=" / ") == "a / b / c and 2 more"
    assert returns({"guide": -20.0, "last": 1.234}) == "guide -20.0, last 1.2"
