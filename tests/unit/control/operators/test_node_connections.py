from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.control.operators.node_connections import NodeConnections
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.xmlrpc import Value

pytestmark = pytest.mark.anyio
OURS = "http://10.0.0.1:19001/"
THEIRS = "http://10.0.0.5:41234/"
TOPIC = "/cmd_vel"


class Asked:
    """A delivery whose node has these rows of getBusInfo."""

    def __init__(self) -> None:
        self.answer: Value = [1, "bus info", []]
        self.fails = False
        self.lists: list[tuple[str, ...] | None] = [(OURS,)]

    async def ask(self, _incarnation: Any, method: str) -> Value:
        assert method == "getBusInfo"
        if self.fails:
            raise CallFailedError("no answer")
        return self.answer

    def list_of(self, _incarnation: Any, topic: str) -> tuple[str, ...] | None:
        assert topic == TOPIC
        return self.lists.pop(0) if len(self.lists) > 1 else self.lists[0]


def connections(
    master: str = "http://10.111.0.2:11311/", isolation: str = "netns"
) -> tuple[NodeConnections, Asked]:
    asked, registry = Asked(), SimpleNamespace(holder={"/base": "the base"}.get)
    around = SimpleNamespace(master=master, firewall=SimpleNamespace(isolation=isolation))
    return NodeConnections(cast(Any, registry), cast(Any, asked), cast(Any, around)), asked


@pytest.mark.parametrize(
    ("isolation", "host", "here"),
    [
        ("netns", "127.0.0.1", True), ("netns", "10.111.0.2", True), ("netns", "10.111.0.1", True),
        ("netns", "10.111.0.5", False), ("netns", "192.168.1.10", False), ("netns", "fd00::1", False),
        ("none", "192.168.1.10", False), ("none", "10.111.0.1", False),
        ("container", "172.29.77.10", None), ("container", "10.111.0.2", True), ("container", "::1", True),
    ],
)  # fmt: skip
async def test_the_machine_of_a_host_is_known_or_said_to_be_unknown(
    isolation: str, host: str, here: bool | None
) -> None:
    found, _ = connections(isolation=isolation)
    assert found.is_here(host) is here


async def test_before_the_supervisor_reports_no_address_is_the_appliances() -> None:
    found, _ = connections(master="")
    assert (found.is_here("10.111.0.1"), found.is_here("127.0.0.1")) == (False, True)


def row(uri: str, direction: str = "i", topic: str = TOPIC) -> list[Value]:
    return [1, uri, direction, "TCPROS", topic, 1, "TCPROS connection on port 4 to [10.0.0.5:1]"]


@pytest.mark.parametrize(
    ("rows", "unknown_publishers"),
    [
        ([row(OURS)], []),
        ([row("http://10.0.0.1:19001")], []),
        ([row(OURS), row(THEIRS)], [THEIRS]),
        ([row(THEIRS, "o"), row(THEIRS, topic="/odom")], []),
        ([row("http://10.0.0.1:19002/")], ["http://10.0.0.1:19002/"]),
        ([row("http://[broken/")], ["http://[broken/"]),
        ([], []),
    ],
)
async def test_publishers_that_the_appliance_did_not_give_are_unknown(
    rows: list[Value], unknown_publishers: list[str]
) -> None:
    """The port counts, because with isolation none nodes have the appliance's address."""
    found, asked = connections()
    asked.answer = [1, "bus info", rows]
    assert await found.unknown_publishers("/base", TOPIC) == unknown_publishers


async def test_a_list_that_changes_while_the_node_answers_makes_no_publisher_unknown() -> None:
    found, asked = connections()
    asked.answer, asked.lists = [1, "", [row(THEIRS), row(OURS)]], [(THEIRS,), (OURS,)]
    assert await found.unknown_publishers("/base", TOPIC) == []


@pytest.mark.parametrize(
    "answer", [None, [0, "no", []], [1, "", 5], [1, "", [5]], [1, "", [[1, "x"]]], "x", []]
)
async def test_without_a_usable_answer_there_is_no_evidence(answer: Any) -> None:
    found, asked = connections()
    asked.answer = answer
    assert await found.unknown_publishers("/base", TOPIC) is None
    asked.fails = True
    assert await found.unknown_publishers("/base", TOPIC) is None
    assert await found.unknown_publishers("/another", TOPIC) is None


async def test_many_unknown_publishers_are_cut() -> None:
    found, asked = connections()
    asked.answer = [1, "", [row(f"http://10.0.0.{number}:1/" + "x" * 500) for number in range(50)]]
    unknown_publishers = await found.unknown_publishers("/base", TOPIC)
    assert (
        unknown_publishers is not None
        and len(unknown_publishers) == 10
        and max(map(len, unknown_publishers)) == 200
    )
