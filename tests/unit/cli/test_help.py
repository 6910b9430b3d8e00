import pytest

from appliance.cli.main import app
from distribution.command_line_page import commands

VERBS = {" ".join(words): command for words, command, _context in commands(("rosrv",), app)}


def test_there_are_verbs() -> None:
    assert len(VERBS) > 100


@pytest.mark.parametrize("name", sorted(VERBS))
def test_a_paragraph_of_help_is_one_line_that_each_terminal_breaks(name: str) -> None:
    paragraphs = (VERBS[name].help or "").split("\n\n")
    assert [one for one in paragraphs if "\n" in one and not one.startswith("\b\n")] == []
