import io
import sys

import pytest

from rosmop.tool.terminal import say


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("environment", "style", "written"),
    [
        ({"TERM": "xterm"}, "bold red", "\x1b[31m\x1b[1mheld\\x1b[0m\x1b[0m\n"),
        ({"TERM": "xterm"}, "dim", "\x1b[2mheld\\x1b[0m\x1b[0m\n"),
        ({"TERM": "xterm"}, "", "held\\x1b[0m\n"),
        ({"TERM": "dumb"}, "red", "held\\x1b[0m\n"),
        ({"TERM": "xterm", "NO_COLOR": "1"}, "red", "held\\x1b[0m\n"),
    ],
)
def test_a_line_is_coloured_only_on_a_terminal_that_can_show_it(
    environment: dict[str, str], style: str, written: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "stdout", terminal := _Terminal())
    say("held\x1b[0m", style)
    assert terminal.getvalue() == written
