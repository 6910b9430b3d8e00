"""A rospy node gives its callers the same answers through a plain master and through the appliance.

Differences by design: URIs and process ids (only their form is compared), the numbers of connections, and the
text about an invalid parameter, as in `side_by_side`.
"""

import re
from collections.abc import Iterator
from typing import Any

import pytest

from tests.integration.conformance.nodes import order, rospy_node
from tests.integration.conformance.side_by_side import TESTER, Answers, differences
from tests.support.nodes import RosSession
from tests.support.processes import ThisMachine
from tests.support.rosmaster import call_on
from tests.support.site import Masters

TCPROS = [["TCPROS"]]
READS = (
    "getPid",
    "getUri",
    "getName",
    "getMasterUri",
    "getPublications",
    "getSubscriptions",
    "getBusInfo",
    "getBusStats",
)
ERRORS: tuple[tuple[Any, ...], ...] = (
    *((method,) for method in (*READS, "requestTopic", "shutdown")),
    *((method, TESTER, "more") for method in READS),
    *((method, 5) for method in READS),
    ("requestTopic", TESTER),
    ("requestTopic", TESTER, "/chatter"),
    ("requestTopic", TESTER, "/chatter", TCPROS, "more"),
    ("requestTopic", TESTER, "/nothing", TCPROS),
    ("requestTopic", TESTER, "/heard", TCPROS),
    ("requestTopic", TESTER, "nothing", TCPROS),
    ("requestTopic", TESTER, "", TCPROS),
    ("requestTopic", TESTER, 5, TCPROS),
    ("requestTopic", TESTER, [], TCPROS),
    ("requestTopic", TESTER, "/with space", TCPROS),
    ("requestTopic", TESTER, "/chatter", []),
    ("requestTopic", TESTER, "/chatter", ""),
    ("requestTopic", TESTER, "/chatter", 0),
    ("requestTopic", TESTER, "/chatter", {}),
    ("shutdown", TESTER),
    ("shutdown", TESTER, "a", "b"),
    ("shutdown", 5, "a"),
)
SERVED: tuple[tuple[Any, ...], ...] = (
    *((method, caller) for method in READS[:6] for caller in ("", TESTER)),
    ("requestTopic", TESTER, "/chatter", TCPROS),
    ("requestTopic", TESTER, "chatter", TCPROS),
    ("requestTopic", TESTER, "/chatter", [["UDPROS"], ["TCPROS"]]),
)


@pytest.fixture(scope="module")
def pair(masters: Masters, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """Return the URIs of a node that publishes /chatter and subscribes to /heard.

    The first is by a plain master, the second by the appliance.
    """
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
    """Replace URIs and process ids by placeholders, without ports."""
    if isinstance(answer, list):
        return [formed(one) for one in answer]
    if isinstance(answer, str):
        return re.sub(r"(?<=127.0.0.1:)\d+/?", "PORT", answer)
    return "pid" if isinstance(answer, int) and answer > 1 else answer


def asked(pair: tuple[str, str], step: tuple[Any, ...]) -> Answers:
    """Make the same call through both masters, and remove differences by design."""
    plain, appliance = (formed(call_on(ThisMachine(), uri, *step)) for uri in pair)
    return Answers(plain, appliance)


@pytest.mark.parametrize("step", ERRORS, ids=repr)
def test_an_error_of_the_caller(pair: tuple[str, str], step: tuple[Any, ...]) -> None:
    answers = asked(pair, step)
    assert answers.plain[0] == -1
    found = differences(answers)
    assert [one for one in found if not one.startswith("value [] / [[], [], []]")] == []


@pytest.mark.parametrize("step", SERVED, ids=repr)
def test_a_call_that_is_served(pair: tuple[str, str], step: tuple[Any, ...]) -> None:
    answers = asked(pair, step)
    assert answers.plain[0] == 1
    assert differences(answers) == []


@pytest.mark.parametrize("method", ["getBusInfo", "getBusStats"])
def test_connection_information(pair: tuple[str, str], method: str) -> None:
    """Connections change at any time, so only the form of the value is compared, with code and text."""
    answers = asked(pair, (method, TESTER))
    assert answers.plain[:2] == answers.appliance[:2]
    assert len(answers.plain) == len(answers.appliance) == 3
    if method == "getBusStats":
        assert [[row[0] for row in part] for part in answers.plain[2]] == [
            [row[0] for row in part] for part in answers.appliance[2]
        ]


@pytest.mark.parametrize("protocols", [5, [5]], ids=repr)
def test_malformed_protocols(pair: tuple[str, str], protocols: Any) -> None:
    """The code is rospy's; its text is a Python error, while the appliance names the parameter."""
    answers = asked(pair, ("requestTopic", TESTER, "/chatter", protocols))
    assert (answers.plain[0], answers.plain[2]) == (answers.appliance[0], answers.appliance[2]) == (-1, [])
    assert "[protocols]" in answers.appliance[1]


@pytest.mark.parametrize("protocols", [[["UDPROS"]], [[]]], ids=repr)
def test_no_protocol_in_common(pair: tuple[str, str], protocols: list[Any]) -> None:
    """Without a common protocol the answer is 0, not a caller's error; the appliance lists offered and relayed ones."""
    answers = asked(pair, ("requestTopic", TESTER, "/chatter", protocols))
    assert (answers.plain[0], answers.plain[2]) == (answers.appliance[0], answers.appliance[2]) == (0, [])
    assert "relays only TCPROS" in answers.appliance[1]
