import json
import sys

import pytest

from appliance.base.counted import counted
from appliance.cli.output import loaded_by, moment, say_json, say_row, usage_error
from rosmop.tool.terminal import printable, say


def test_control_characters_never_reach_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    say("/evil\x1b[2J\nallow \u202e[red]")
    assert capsys.readouterr().out == "/evil\\x1b[2J\\nallow \\u202e[red]\n"


def test_an_error_escapes_what_it_repeats(capsys: pytest.CaptureFixture[str]) -> None:
    assert usage_error("no topic /\x1b[2J\u202e", "rosrv topic").exit_code == 2
    assert capsys.readouterr().err == "rosrv topic: no topic /\\x1b[2J\\u202e\n"


def test_printable_text_is_unchanged() -> None:
    assert printable("größer als 3 µs …") == "größer als 3 µs …"


def test_nouns_agree_with_their_numbers() -> None:
    assert [counted(number, "error") for number in (0, 1, 2)] == ["0 errors", "1 error", "2 errors"]


def test_times_are_in_utc() -> None:
    assert moment(1_795_164_925.9) == "2026-11-20 08:55Z"


def test_an_object_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    say_json({"name": "a\nb\x1b"})
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert json.loads(out) == {"name": "a\nb\x1b"}


@pytest.mark.parametrize(
    ("who", "shown"),
    [
        ("disk", "read from disk 1970-01-01 00:00Z"),
        ("alice", "loaded by alice 1970-01-01 00:00Z"),
        ("not confirmed in time", "rolled back automatically (not confirmed in time) 1970-01-01 00:00Z"),
    ],
)
def test_a_revision_names_its_loader(who: str, shown: str) -> None:
    assert loaded_by(who, 0.0) == shown


def test_a_row_fits_the_terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    row = ["laptop    10.113.11.2", "up", "from 192.168.1.7 for 5 s", "ports closed"]
    say_row(row)
    assert capsys.readouterr().out == "  ".join(row) + "\n"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setenv("COLUMNS", "40")
    say_row(row)
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert lines == ["laptop    10.113.11.2  up", "    from 192.168.1.7 for 5 s", "    ports closed"]
