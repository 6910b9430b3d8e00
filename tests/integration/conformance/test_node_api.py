"""A rospy node is asked the same by whoever finds it through a plain master and through the appliance.

What must differ by design: URIs and process ids (only their form is compared), the numbers of connections, and the
words about a parameter that is not valid, as in `side_by_side`.
"""

import re
from collections.abc import Iterator
from typing import Any

import pytest

from tests.integration.conformance.conftest import LocalSite
from tests.integration.conformance.nodes import order, rospy_node
from tests.integration.conformance.side_by_side import TESTER, Answers, differences
from tests.support.nodes import RosSession, has_ros
from tests.support.processes import ThisMachine
from tests.support.requirements import need_root, needs
from tests.support.rosmaster import call_on

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
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """The URIs that a plain master and the appliance tell of a node that publishes /chatter and subscribes /heard."""
    need_root()
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    homes = [tmp_path_factory.mktemp(mode) for mode in ("plain", "appliance")]
    with (
        LocalSite("plain", homes[0]) as plain,
        LocalSite("appliance", homes[1]) as appliance,
        RosSession(plain.master_uri, homes[0]) as one,
        RosSession(appliance.master_uri, homes[1]) as other,
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
    """URIs and process ids as such, ports left out."""
    if isinstance(answer, list):
        return [formed(one) for one in answer]
    if isinstance(answer, str):
        return re.sub(r"(?<=127.0.0.1:)\d+/?", "PORT", answer)
    return "pid" if isinstance(answer, int) and answer > 1 else answer


def asked(pair: tuple[str, str], step: tuple[Any, ...]) -> Answers:
    """The same call to both, with what differs by design made alike."""
    plain, appliance = (formed(call_on(ThisMachine(), uri, *step)) for uri in pair)
    return Answers(plain, appliance)


@pytest.mark.parametrize("step", ERRORS, ids=repr)
def test_an_error_of_the_caller(pair: tuple[str, str], step: tuple[Any, ...]) -> None:
    """What the caller did wrong is answered with -1 and an empty value, by the appliance as by rospy."""
    answers = asked(pair, step)
    assert answers.plain[0] == -1
    found = differences(answers)
    assert [one for one in found if not one.startswith("value [] / [[], [], []]")] == []


@pytest.mark.parametrize("step", SERVED, ids=repr)
def test_a_call_that_is_served(pair: tuple[str, str], step: tuple[Any, ...]) -> None:
    """Whoever asks a node finds the same code, words and value, also a tool without a name."""
    answers = asked(pair, step)
    assert answers.plain[0] == 1
    assert differences(answers) == []


@pytest.mark.parametrize("method", ["getBusInfo", "getBusStats"])
def test_what_is_known_of_connections(pair: tuple[str, str], method: str) -> None:
    """Connections come and go by themselves; code, words and the form of the value are alike."""
    answers = asked(pair, (method, TESTER))
    assert answers.plain[:2] == answers.appliance[:2]
    assert len(answers.plain) == len(answers.appliance) == 3
    if method == "getBusStats":
        assert [[row[0] for row in part] for part in answers.plain[2]] == [
            [row[0] for row in part] for part in answers.appliance[2]
        ]


@pytest.mark.parametrize("protocols", [5, [5]], ids=repr)
def test_protocols_of_no_form(pair: tuple[str, str], protocols: Any) -> None:
    """The code is rospy's; its words are those of a Python error, the appliance's name the parameter."""
    answers = asked(pair, ("requestTopic", TESTER, "/chatter", protocols))
    assert (answers.plain[0], answers.plain[2]) == (answers.appliance[0], answers.appliance[2]) == (-1, [])
    assert "[protocols]" in answers.appliance[1]


@pytest.mark.parametrize("protocols", [[["UDPROS"]], [[]]], ids=repr)
def test_no_protocol_in_common(pair: tuple[str, str], protocols: list[Any]) -> None:
    """That is no error of the caller: 0; the appliance says what it carries and what was offered."""
    answers = asked(pair, ("requestTopic", TESTER, "/chatter", protocols))
    assert (answers.plain[0], answers.plain[2]) == (answers.appliance[0], answers.appliance[2]) == (0, [])
    assert "only TCPROS is carried" in answers.appliance[1]
