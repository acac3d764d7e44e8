"""Text from outside is shown as text, whatever it is."""

import pytest

from epipole.schemas.text import LONGEST_LINE, as_line, as_markdown_text


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("sensor 1: 0.5 km, Größe", "sensor 1: 0.5 km, Größe"),
        ("two\nlines\r", "two\\nlines\\r"),
        ("\x1b[2J\x07\x9b1m", "\\x1b[2J\\x07\\x9b1m"),  # commands to the terminal
        ("a\u202eb\u2028c\u200b", "a\\u202eb\\u2028c\\u200b"),  # order of writing, line separator
        ("\udcff.mcap", "\\udcff.mcap"),  # a byte of a name that is not UTF-8
    ],
)
def test_a_line_is_one_line_that_can_be_printed(text, line):
    assert as_line(text) == line
    assert as_line(text).encode()


def test_a_line_is_cut():
    assert as_line("a" * LONGEST_LINE) == "a" * LONGEST_LINE
    cut = as_line("\n" * 10**6)
    assert len(cut) == LONGEST_LINE
    assert cut.endswith("...")


@pytest.mark.parametrize(
    "text",
    [
        "<script>alert(1)</script>", "[a](https://b.c)", "![a](//b.c)", "https://b.c", "www.b.c",
        "WWW.b.c", "me@b.c", "`a`", "*a*", "_a_", "~~a~~", "a | b", "# a", "&lt;", "\\*",
        "a\n\n# b",
    ],
)  # fmt: skip
def test_markdown_has_no_marks_of_the_text(text):
    shown = as_markdown_text(text)
    rest = shown.replace("&#", "").lower()
    assert not set(rest) & set("<>[]!`*_~|#&\\@:\n")
    assert "www." not in rest


def test_plain_words_stay_as_they_are_in_markdown():
    assert (
        as_markdown_text("clock is off by +0.5 s (3 sigma)") == "clock is off by +0.5 s (3 sigma)"
    )
