from collections.abc import Callable
from typing import Any

import pytest

from appliance.channel.answers.status import FirewallState
from appliance.channel.messages import FirewallReported
from appliance.control.links.supervisor_link import Surroundings
from appliance.control.operators.node_connections import NodeConnections
from appliance.master.endpoints.delivery import Delivery
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.quotas.pool import QuotaClass
from appliance.rpc.xmlrpc_client import CallFailedError
from roswire.xmlrpc import Value
from tests.support.incarnations import incarnation
from tests.support.scripted_nodes import ScriptedNodes

pytestmark = pytest.mark.anyio
OURS = "http://10.0.0.1:19001/"
THEIRS = "http://10.0.0.5:41234/"
TOPIC = "/cmd_vel"


def surroundings(isolation: str = "netns", master: str = "http://10.111.0.2:11311/") -> Surroundings:
    around = Surroundings()
    around.master, around.firewall = master, FirewallReported(isolation, FirewallState())
    return around


class Asked:
    """The connections of /base, which answers `getBusInfo` with `answer`, and has got the list `publishers`."""

    def __init__(self, around: Surroundings | None = None) -> None:
        self.answer: Value = [1, "bus info", []]
        self.during_answer: Callable[[], None] = lambda: None
        registry = Registry()
        self.nodes = ScriptedNodes(registry)
        self.nodes.answer = self._bus_info
        self.delivery = Delivery(
            self.nodes, troubled=lambda *_: None, quota_class=lambda _host: QuotaClass.REGISTERED
        )
        self._base = incarnation("/base")
        registry.add(self._base)
        registry.register(self._base, Kind.SUBSCRIPTION, TOPIC, "geometry_msgs/Twist")
        self.connections = NodeConnections(registry, self.delivery, around or surroundings())
        self.list_is(OURS)

    def list_is(self, *publishers: str) -> None:
        self.delivery.answered(self._base, TOPIC, publishers)

    async def _bus_info(self, _node: Incarnation, method: str, _parameters: tuple[Value, ...]) -> Value:
        assert method == "getBusInfo"
        self.during_answer()
        if self.nodes.silent:
            raise CallFailedError("no answer")
        return self.answer

    async def unknown(self, node: str = "/base") -> list[str] | None:
        return await self.connections.unknown_publishers(node, TOPIC)


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
    assert Asked(surroundings(isolation)).connections.is_here(host) is here


async def test_before_the_supervisor_reports_no_address_is_the_appliances() -> None:
    found = Asked(surroundings(master="")).connections
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
    asked = Asked()
    asked.answer = [1, "bus info", rows]
    assert await asked.unknown() == unknown_publishers


async def test_a_list_that_changes_while_the_node_answers_makes_no_publisher_unknown() -> None:
    asked = Asked()
    asked.list_is(THEIRS)
    asked.answer, asked.during_answer = [1, "", [row(THEIRS), row(OURS)]], lambda: asked.list_is(OURS)
    assert await asked.unknown() == []


@pytest.mark.parametrize(
    "answer", [None, [0, "no", []], [1, "", 5], [1, "", [5]], [1, "", [[1, "x"]]], "x", []]
)
async def test_without_a_usable_answer_there_is_no_evidence(answer: Any) -> None:
    asked = Asked()
    asked.answer = answer
    assert await asked.unknown() is None
    asked.nodes.silent = {"/base"}
    assert await asked.unknown() is None
    assert await asked.unknown("/another") is None


async def test_many_unknown_publishers_are_cut() -> None:
    asked = Asked()
    asked.answer = [1, "", [row(f"http://10.0.0.{number}:1/" + "x" * 500) for number in range(50)]]
    unknown_publishers = await asked.unknown()
    assert (
        unknown_publishers is not None
        and len(unknown_publishers) == 10
        and max(map(len, unknown_publishers)) == 200
    )
