"""Tests of `appliance.cli.output`."""

import json

import pytest

from appliance.cli.output import moment, say_json, usage_error
from rosmop.tool.terminal import counted, printable, say


def test_control_characters_never_reach_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """A stranger's name that would clear the screen, or begin a line of its own, is shown as what it is."""
    say("/evil\x1b[2J\nallow \u202e[red]")
    assert capsys.readouterr().out == "/evil\\x1b[2J\\nallow \\u202e[red]\n"


def test_a_refusal_repeats_nothing_that_a_terminal_acts_on(capsys: pytest.CaptureFixture[str]) -> None:
    """What was given, or what an appliance elsewhere answered, stands in it as what it is."""
    assert usage_error("no topic /\x1b[2J\u202e", "rosrv topic").exit_code == 2
    assert capsys.readouterr().err == "rosrv topic: no topic /\\x1b[2J\\u202e\n"


def test_what_is_printable_stays() -> None:
    """Text of people's languages is not escaped."""
    assert printable("größer als 3 µs …") == "größer als 3 µs …"


def test_one_is_one_and_two_are_two() -> None:
    """Numbers agree with their nouns."""
    assert [counted(number, "error") for number in (0, 1, 2)] == ["0 errors", "1 error", "2 errors"]


def test_moments_are_in_utc() -> None:
    """A time is shown to the minute, and says its zone."""
    assert moment(1_795_164_925.9) == "2026-11-20 08:55Z"


def test_an_object_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """A program reads one object from each line, whatever strings are in it."""
    say_json({"name": "a\nb\x1b"})
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert json.loads(out) == {"name": "a\nb\x1b"}
