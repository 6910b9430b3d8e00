import itertools

import pytest

from appliance.cli.lazy import PANELS, in_order, panel_of
from appliance.cli.main import DENY, DRIVER, NODES, all_verbs, first_contact, next_commands
from appliance.cli.verb_table import Group
from tests.support.rows import require_rows


def asked(*answers: str) -> tuple[int, str]:
    given = iter(answers)
    said: list[str] = []

    def read(_prompt: str) -> str:
        answer = next(given, None)
        if answer is None:
            raise EOFError
        return answer

    return first_contact(read, said.append), "\n".join(said)


def test_three_answers_give_the_next_command() -> None:
    status, said = asked("", "2", "1")
    assert status == 0
    assert "Next:  rosrv survey --master http://localhost:11311 --policy draft.ini" in said
    assert "audit-only = all" in said
    assert "rosrv door add NAME" in said


def test_a_robot_that_is_nowhere_yet_needs_one_question() -> None:
    status, said = asked("3")
    assert (status, DRIVER.text in said) == (0, False)
    assert "Next:  sudo rosrv demo" in said


@pytest.mark.parametrize("answers", [("9", "x", "0", "1", "1", "2"), ("2", "3", "2")])
def test_only_an_offered_number_is_an_answer(answers: tuple[str, ...]) -> None:
    status, said = asked(*answers)
    assert status == 0
    assert said.count("write a number from 1 to 3") == (3 if answers[0] == "9" else 0)


def test_an_end_of_the_input_ends_the_questions() -> None:
    assert asked("1")[0] == 1


def test_every_proposed_command_exists() -> None:
    verbs = all_verbs()
    ways = itertools.product(
        range(len(NODES.answers) - 1), range(len(DRIVER.answers)), range(len(DENY.answers))
    )
    for nodes, driver, deny in ways:
        for command, _what in next_commands(nodes, driver, deny=bool(deny)):
            words = command.removeprefix("sudo ").split()
            verb = verbs[words[1]]
            assert words[0] == "rosrv"
            assert not isinstance(verb, Group) or words[2] in verb.verbs, command


def test_every_verb_has_its_panel_in_the_help() -> None:
    verbs = all_verbs()
    named = {name for names in PANELS.values() for name in names}
    require_rows(verbs, named & verbs.keys(), "a panel of appliance/cli/lazy.py")
    assert in_order(["purge", "up", "newest"]) == ["up", "purge", "newest"]
    assert panel_of("newest") == "Further commands"
