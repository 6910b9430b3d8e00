import asyncio
import json
from collections.abc import Collection, Mapping
from typing import Any

import pytest
from msgspec import Raw

from appliance.features.doors.client_requests import CallOfService
from appliance.features.doors.known_types import KnownType, KnownTypes
from appliance.features.doors.lookout import Lookout, in_turn
from appliance.features.doors.rosapi import Rosapi
from appliance.features.doors.surroundings import VisibleGraph
from appliance.features.doors.values import ValueLimits
from roswire.definitions import Definitions
from roswire.errors import DefinitionError, LimitExceededError, ProtocolError, RosError
from roswire.node import MasterDenialError
from roswire.node.network import PeerUnreachableError, ServiceFailedError
from roswire.standard import standard_definitions
from roswire.xmlrpc import Value

pytestmark = pytest.mark.anyio
OWN = Definitions.from_files({"own/Load.msg": "int8 x"})


async def ask(rosapi: Rosapi, service: str, values: str = "{}") -> Any:
    answer = rosapi.answer(CallOfService(service, 1, Raw(values.encode())))
    assert answer is not None
    return json.loads(bytes(await answer))


class Robot:
    """A robot whose nodes answer, and a guest with 400 names that never do."""

    def __init__(self, kind: str, hosts: int) -> None:
        self.types = KnownTypes(standard_definitions(), ValueLimits())
        self.asked: list[str] = []
        self.denied = {"/robot/denied"}
        self.failure: RosError | None = None
        guests = {f"/a_guest/{number:03}": [f"/guest_{number % hosts}"] for number in range(400)}
        own = {f"/robot/{number:02}": ["/base"] for number in range(60)} | {"/robot/denied": ["/base"]}
        names = guests | own
        self.graph_now = VisibleGraph(
            publishers=names if kind == "topic" else {},
            subscribers={},
            services=names if kind == "service" else {},
            types=dict.fromkeys(names, "own/Load") if kind == "topic" else {},
        )
        self.lookout = Lookout(self, self.types, self, self.hosts)

    async def hosts(self, nodes: Collection[str]) -> Mapping[str, str]:
        return {node: "guest" if node.startswith("/guest") else "robot" for node in nodes}

    async def graph(self) -> VisibleGraph:
        return self.graph_now

    async def _answer(self, name: str) -> None:
        self.asked.append(name)
        if self.failure is not None:
            raise self.failure
        if name in self.denied:
            raise MasterDenialError(f"{name} is denied (site.ini:4)")
        if name.startswith("/a_guest"):
            await asyncio.sleep(30)
            raise PeerUnreachableError(f"no publisher of {name} answers")

    async def learn(self, topic: str) -> KnownType:
        async with asyncio.timeout(1):
            try:
                await self._answer(topic)
            except asyncio.CancelledError:
                raise PeerUnreachableError(f"no publisher of {topic} answers") from None
        text = OWN.full_text("own/Load")
        header = {"type": "own/Load", "md5sum": OWN.md5sum("own/Load"), "message_definition": text}
        return self.types.learn(header)

    def heard_type(self, _topic: str) -> KnownType | None:
        return None

    async def service_header(self, service: str) -> Mapping[str, str]:
        await self._answer(service)
        return {"type": "std_srvs/Trigger"}

    async def service_uri(self, _service: str) -> str:
        return ""

    async def parameter(self, _call: str, *_arguments: Value) -> Value:
        return 0

    async def set_parameter(self, name: str, value: Value) -> None: ...

    def time(self) -> tuple[int, int]:
        return 0, 0


@pytest.mark.parametrize("hosts", [1, 400])
@pytest.mark.parametrize("kind", ["topic", "service"])
async def test_names_that_never_answer_delay_only_those_of_their_host(kind: str, hosts: int) -> None:
    robot = Robot(kind, hosts)
    for _look in range(3):
        seen = await robot.lookout.look()
        await asyncio.sleep(2)
    found = [topic.topic for topic in seen.topics] + [service.service for service in seen.services]
    assert sum(name.startswith("/robot") for name in found) == 60
    before = len(robot.asked)
    for _look in range(30):
        await robot.lookout.look()
        await asyncio.sleep(2)
    later = [name for name in robot.asked[before:] if name.startswith("/robot")]
    assert later == []  # the robot's own answers are kept
    assert {*robot.asked} >= {*robot.graph_now.publishers, *robot.graph_now.services}  # and all were asked


async def test_a_new_name_of_the_robot_is_asked_about_in_the_next_look() -> None:
    robot = Robot("topic", 1)
    for _look in range(20):
        await robot.lookout.look()
        await asyncio.sleep(2)
    before = len(robot.asked)
    assert isinstance(robot.graph_now.publishers, dict)
    robot.graph_now.publishers["/robot/new"] = ["/base"]
    robot.graph_now.types["/robot/new"] = "own/Load"  # type: ignore[index]  # a mapping of the test
    await robot.lookout.look()
    assert "/robot/new" in robot.asked[before : before + 2]


@pytest.mark.parametrize(
    "failure",
    [
        PeerUnreachableError("refuses the connection"),
        LimitExceededError("no slot"),
        ProtocolError("closes the connection, or answers with an error"),
        ServiceFailedError("starts"),
        DefinitionError("cannot be read", "own/Load"),
        MasterDenialError("denied (site.ini:4)"),
    ],
    ids=lambda failure: type(failure).__name__,
)
@pytest.mark.parametrize("kind", ["topic", "service"])
async def test_a_failure_at_the_first_look_is_not_kept(kind: str, failure: RosError) -> None:
    """A node that is started again has the same name."""
    robot = Robot(kind, 1)
    robot.denied = set()
    names = {"/robot/late": ["/base"]}
    robot.graph_now = VisibleGraph(
        publishers=names if kind == "topic" else {},
        subscribers={},
        services=names if kind == "service" else {},
        types={"/robot/late": "own/Load"} if kind == "topic" else {},
    )
    robot.failure = failure
    before = await robot.lookout.look()
    assert not [*before.topics, *before.services]
    robot.failure = None
    if isinstance(failure, MasterDenialError):
        robot.lookout.policy_changed()
    await asyncio.sleep(11)
    seen = await robot.lookout.look()
    assert len([*seen.topics, *seen.services]) == 1
    if kind == "service":
        assert await robot.lookout.service_types() == {"/robot/late": "std_srvs/Trigger"}


async def test_services_are_found_by_their_type_although_some_are_denied_or_silent() -> None:
    """As in every answer that is put together from many, one of them does not make it fail."""
    robot = Robot("service", 1)
    rosapi = Rosapi(robot, robot.types, robot.lookout)
    began = asyncio.get_running_loop().time()
    answer = await ask(rosapi, "/rosapi/services_for_type", '{"type":"std_srvs/Trigger"}')
    assert answer["services"] == [f"/robot/{number:02}" for number in range(60)]
    assert asyncio.get_running_loop().time() - began < 15
    assert await ask(rosapi, "/rosapi/services_for_type", '{"type":"own/None"}') == {"services": []}


@pytest.mark.parametrize(
    "service", ["topics_and_raw_types", "topics", "services", "nodes", "services_for_type"]
)
async def test_an_answer_about_many_does_not_fail_for_one(service: str) -> None:
    robot = Robot("topic", 1)
    robot.denied = {*robot.graph_now.publishers} - {"/robot/00"}
    answer = await ask(Rosapi(robot, robot.types, robot.lookout), f"/rosapi/{service}")
    if service == "topics_and_raw_types":
        texts = dict(zip(answer["topics"], answer["typedefs_full_text"], strict=True))
        assert [topic for topic, text in texts.items() if text] == ["/robot/00"]


def test_a_thing_of_several_hosts_counts_for_the_one_with_the_fewest() -> None:
    shared = ("topic", "/shared")
    rows = [(("topic", f"/g{number}"), ["guest"]) for number in range(9)] + [(shared, ["guest", "robot"])]
    assert in_turn(rows).index(shared) == 1  # type: ignore[arg-type]  # rows of the test
