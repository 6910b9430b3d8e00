"""A rospy node gives the answers to the calls in `conversations/node_api.txt`, behind either master.

Process ids and numbers of connections may differ, in addition to the differences that `side_by_side` allows.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.integration.conformance.nodes import order, rospy_node
from tests.integration.conformance.side_by_side import TESTER, Answers, differences
from tests.support.conversation import conversations_of
from tests.support.conversation_calls import call_of
from tests.support.nodes import RosSession
from tests.support.processes import ThisMachine
from tests.support.rosmaster import call_on
from tests.support.site import Masters

_TEXT = Path(__file__).parents[2] / "unit" / "master" / "conversations" / "node_api.txt"
_CONVERSATIONS = conversations_of(_TEXT.read_text(encoding="utf-8")).conversations


@pytest.fixture(scope="module")
def pair(masters: Masters, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    with (
        masters.lend("plain", "loopback") as plain,
        masters.lend("appliance", "loopback") as appliance,
        RosSession(plain.master_uri, tmp_path_factory.mktemp("plain")) as one,
        RosSession(appliance.master_uri, tmp_path_factory.mktemp("appliance")) as other,
    ):
        found = []
        for site, session in ((plain, one), (appliance, other)):
            node = rospy_node(session, "orders", "voice")
            order(node, "advertise", topic="/chatter", latch=True)
            order(node, "subscribe", topic="/heard")
            found.append(call_on(session.host, site.master_uri, "lookupNode", TESTER, "/voice")[2])
        yield found[0], found[1]


_HERE = ThisMachine()


def formed(answer: Any) -> Any:
    if isinstance(answer, list):
        return [formed(one) for one in answer]
    if isinstance(answer, str):
        return re.sub(r"(?<=127.0.0.1:)\d+/?", "PORT", answer)
    return "pid" if isinstance(answer, int) and answer > 1 else answer


def asked(pair: tuple[str, str], step: tuple[Any, ...]) -> Answers:
    plain, appliance = (formed(call_on(ThisMachine(), uri, *step)) for uri in pair)
    return Answers(plain, appliance)


@pytest.mark.parametrize("title", _CONVERSATIONS)
def test_answers_are_those_of_rospy(pair: tuple[str, str], title: str) -> None:
    for line in _CONVERSATIONS[title].splitlines():
        if " of /voice" not in line:
            continue
        call = call_of(line)
        answers = asked(pair, (call.method, *call.params))
        found = differences(answers)
        if re.search(r"\[protocols\]|relays only", answers.appliance[1]):
            found = [one for one in found if not one.startswith("message ")]
        assert [one for one in found if not one.startswith("value [] / [[], [], []]")] == [], line


@pytest.mark.parametrize("method", ["getPid", "getBusInfo", "getBusStats"])
def test_connection_information(pair: tuple[str, str], method: str) -> None:
    answers = asked(pair, (method, TESTER))
    assert answers.plain[:2] == answers.appliance[:2]
    assert len(answers.plain) == len(answers.appliance) == 3
    if method == "getBusStats":
        assert [[row[0] for row in part] for part in answers.plain[2]] == [
            [row[0] for row in part] for part in answers.appliance[2]
        ]
