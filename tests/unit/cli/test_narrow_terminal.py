"""At 80 columns no row or table hides a part, whatever the names are: it breaks between words, and never within one."""

import ast
import os
import random
from pathlib import Path

import pytest

from appliance.cli.output import row_lines, say_row
from rosmop.tool.tables import add_row, say_table, table_of

ROOT = Path(__file__).parents[3]
COLUMNS = 80
LONG = "/warehouse_3/lift_7/base_controller/diff_drive/cmd_vel_out_of_the_multiplexer_for_the_night_shift"
ROWS = {
    "a guard": [
        "guard night_shift_fence: fence 2, older: rosrv guard upgrade night_shift_fence; on /cmd_vel, /odom,",
        "in force, stopping, 1204 stops, since 2026-11-28 18:03 +0100: stopped at the fence: x -12.25, y 3.40"
        " (/move_base on host:autonomy-computer-3)",
    ],
    "a door": ["maintenance-tablet-of-hall-3", "198.19.240.117", "port 9091 from 10.77.0.0/24, 3 connections"],
    "a host": [
        "host:autonomy-computer-3 (10.113.11.104)", "tunnel up since 2026-11-28 18:03 +0100",
        "certificate until 2027-01-05", "ports closed",
    ],
    "a group": [
        "base: held by host:autonomy-computer-3 (10.113.11.104), 4.2 s left without a message;",
        "waiting: host:tablet-of-the-night-shift (10.113.11.7), door:agent-1 (198.19.240.2)",
    ],
    "a call": ["48213: door:agent-1 (198.19.240.2) call " + LONG + " {'data': True}: waits, 119 s left"],
    "a long name": [LONG, "std_msgs/String", "1 publisher, 2 subscribers, 19.8 Hz"],
    "padding": ["a".ljust(100), "b".ljust(30), "c"],
}  # fmt: skip


def columns(monkeypatch: pytest.MonkeyPatch, width: int = COLUMNS) -> None:
    """Let the output be a terminal."""
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setattr("shutil.get_terminal_size", lambda *_: os.terminal_size((width, 24)))
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("TERM", "dumb")


def check(lines: list[str], parts: list[str], width: int = COLUMNS) -> None:
    assert " ".join(lines).split() == " ".join(parts).split(), "each word is shown, in its order"
    for line in lines:
        assert len(line) <= width or len(line.split()) == 1, f"{line!r} is cut or broken within a word"
        assert line == line.rstrip()


@pytest.mark.parametrize("name", ROWS)
def test_a_row_breaks_between_words(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    columns(monkeypatch)
    say_row(ROWS[name])
    check(capsys.readouterr().out.splitlines(), ROWS[name])


def test_rows_of_any_words_are_whole() -> None:
    chance = random.Random(5)  # noqa: S311  repeatable rows
    for _ in range(500):
        parts = [
            " ".join("x" * chance.choice((1, 3, 8, 20, 90)) for _ in range(chance.randint(1, 12)))
            for _ in range(chance.randint(1, 5))
        ]
        for width in (40, COLUMNS):
            check(row_lines(parts, width), parts, width)
        assert row_lines(parts, None) == ["  ".join(parts)], "in a pipe, a row is one line"


def test_a_table_that_does_not_fit_has_its_cells_below_one_another(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    columns(monkeypatch)
    table = table_of("monitor", "topic", "dropped")
    add_row(table, "night_shift_fence", LONG, "1204")
    say_table(table)
    assert capsys.readouterr().out.split("\n") == [
        "night_shift_fence", f"    topic: {LONG}", "    dropped: 1204", "",
    ]  # fmt: skip


def test_a_table_of_sentences_breaks_them_between_words(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    columns(monkeypatch)
    sentence = "the velocity that a base has when a command slowed it, in metres a second, and when " * 3
    table = table_of("value", "", "meaning")
    add_row(table, "coastFrom", "0.25", sentence)
    say_table(table)
    shown = capsys.readouterr().out
    assert shown.splitlines()[0].split() == ["value", "meaning"]
    assert set(sentence.split()) <= set(shown.split())
    assert max(map(len, shown.splitlines())) <= COLUMNS


def test_all_columns_are_written_by_these_functions() -> None:
    """A line with aligned parts is a row: `say_row` or `say_table` writes it, so it keeps the rule above."""
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for folder in ("appliance", "rosmop", "fleet/src/rosrv_fleet")
        for path in (ROOT / folder).rglob("*.py")
        if "<" in (text := path.read_text(encoding="utf-8")) and "say" in text
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call)
        and ast.unparse(node.func).rpartition(".")[2] in ("say", "echo", "print")
        and any(_is_aligned(part) for part in ast.walk(node))
    ]
    assert found == []


def _is_aligned(part: ast.AST) -> bool:
    if not isinstance(part, ast.FormattedValue) or not isinstance(part.format_spec, ast.JoinedStr):
        return False
    first = part.format_spec.values[0]
    return isinstance(first, ast.Constant) and str(first.value)[:1] in ("<", ">")
