import asyncio
import json
from collections.abc import Collection, Mapping
from typing import Any

import pytest
from msgspec import Raw

from appliance.features.doors.client_requests import CallOfService
from appliance.features.doors.known_types import KnownType, KnownTypes
from appliance.features.doors.lookout import Lookout
from appliance.features.doors.rosapi import Rosapi
from appliance.features.doors.surroundings import VisibleGraph
from appliance.features.doors.values import ValueLimits
from roswire.errors import PeerError
from roswire.node import MasterDenialError
from roswire.node.network import PeerUnreachableError
from roswire.standard import standard_definitions
from roswire.xmlrpc import Value
from tests.support.features.doors.door_world import door_world

pytestmark = pytest.mark.anyio
ACTION = {f"/move_base/{part}": ["/move_base"] for part in ("cancel", "feedback", "goal", "result", "status")}


class StatedSight:
    def __init__(self) -> None:
        self.parameters: dict[str, Value] = {"/rosdistro": "noetic", "/gains": {"p": 1.5, "on": True}}

    async def graph(self) -> VisibleGraph:
        return VisibleGraph(
            publishers={"/odom": ["/base"], **ACTION},
            subscribers={"/cmd_vel": ["/base"]},
            services={"/base/reset": ["/base"]},
            types={"/odom": "nav_msgs/Odometry", "/cmd_vel": "geometry_msgs/Twist"},
        )

    async def service_header(self, _service: str) -> Mapping[str, str]:
        return {"type": "std_srvs/Trigger"}

    async def service_uri(self, _service: str) -> str:
        return "rosrpc://10.0.0.3:4000"

    async def parameter(self, call: str, *arguments: Value) -> Value:
        match call, arguments:
            case "getParam", (str(name),) if name in self.parameters:
                return self.parameters[name]
            case "hasParam", (str(name),) if name != "/secret":
                return name in self.parameters
            case "getParamNames", ():
                return [*self.parameters]
        raise MasterDenialError(f"{call}: denied by [Parameters] (site.ini:9)")

    async def set_parameter(self, name: str, value: Value) -> None:
        self.parameters[name] = value

    def time(self) -> tuple[int, int]:
        return 7, 8


class Silent:
    async def learn(self, topic: str) -> KnownType:
        raise PeerUnreachableError(f"no publisher of {topic} answers")

    def heard_type(self, _topic: str) -> KnownType | None:
        return None


async def no_hosts(_nodes: Collection[str]) -> Mapping[str, str]:
    return {}


@pytest.fixture
def rosapi() -> Rosapi:
    types, sight = KnownTypes(standard_definitions(), ValueLimits()), StatedSight()
    return Rosapi(sight, types, Lookout(sight, types, Silent(), no_hosts))


async def ask(rosapi: Rosapi, service: str, values: str = "{}") -> Any:
    answer = rosapi.answer(CallOfService(service, 1, Raw(values.encode())))
    assert answer is not None
    return json.loads(bytes(await answer))


@pytest.mark.parametrize(
    ("service", "values", "answer"),
    [
        ("topic_type", '{"topic":"/odom"}', {"type": "nav_msgs/Odometry"}),
        ("topic_type", '["/odom"]', {"type": "nav_msgs/Odometry"}),
        ("topic_type", '{"topic":"/hidden"}', {"type": ""}),
        ("topics_for_type", '{"type":"geometry_msgs/Twist"}', {"topics": ["/cmd_vel"]}),
        ("publishers", '{"topic":"/odom"}', {"publishers": ["/base"]}),
        ("subscribers", '{"topic":"/odom"}', {"subscribers": []}),
        ("services", "{}", {"services": ["/base/reset"]}),
        ("services_for_type", '{"type":"std_srvs/Trigger"}', {"services": ["/base/reset"]}),
        ("service_type", '{"service":"/base/reset"}', {"type": "std_srvs/Trigger"}),
        ("service_node", '{"service":"/base/reset"}', {"node": "/base"}),
        ("service_providers", '{"service":"/none"}', {"providers": []}),
        ("service_host", '{"service":"/base/reset"}', {"host": "10.0.0.3"}),
        ("nodes", "{}", {"nodes": ["/base", "/move_base"]}),
        (
            "node_details",
            '{"node":"/base"}',
            {"subscribing": ["/cmd_vel"], "publishing": ["/odom"], "services": ["/base/reset"]},
        ),
        ("action_servers", "{}", {"action_servers": ["/move_base"]}),
        ("get_param", '{"name":"/rosdistro"}', {"value": '"noetic"'}),
        ("get_param", '{"name":"/gains"}', {"value": '{"p":1.5,"on":true}'}),
        ("get_param", '{"name":"/none","default":"5"}', {"value": "5"}),
        ("get_param", '{"name":"/none"}', {"value": "null"}),
        ("delete_param", '{"name":"/none"}', {}),
        ("has_param", '{"name":"/none"}', {"exists": False}),
        ("get_param_names", "[]", {"names": ["/rosdistro", "/gains"]}),
        ("get_time", "{}", {"time": {"secs": 7, "nsecs": 8}}),
    ],
)
async def test_answers_have_the_fields_of_rosapi(
    rosapi: Rosapi, service: str, values: str, answer: Any
) -> None:
    assert await ask(rosapi, f"/rosapi/{service}", values) == answer


async def test_topics_come_with_types_and_full_texts(rosapi: Rosapi) -> None:
    answer = await ask(rosapi, "/rosapi/topics_and_raw_types")
    shown = dict(
        zip(answer["topics"], zip(answer["types"], answer["typedefs_full_text"], strict=True), strict=True)
    )
    assert (
        shown["/cmd_vel"][0] == "geometry_msgs/Twist" and "MSG: geometry_msgs/Vector3" in shown["/cmd_vel"][1]
    )
    assert shown["/move_base/goal"] == ("", "")


async def test_details_list_each_inner_type_once(rosapi: Rosapi) -> None:
    answer = await ask(rosapi, "/rosapi/message_details", '{"type":"actionlib_msgs/GoalStatus"}')
    assert [one["type"] for one in answer["typedefs"]] == [
        "actionlib_msgs/GoalStatus",
        "actionlib_msgs/GoalID",
        "time",
    ]
    status = answer["typedefs"][0]
    assert status["fieldtypes"] == ["actionlib_msgs/GoalID", "uint8", "string"]
    assert status["examples"] == ["{}", "0", ""] and status["fieldarraylen"] == [-1, -1, -1]
    assert status["constnames"][0] == "ABORTED" and status["constvalues"][0] == "4"
    answer = await ask(rosapi, "/rosapi/service_request_details", '{"type":"std_srvs/SetBool"}')
    assert answer["typedefs"][0]["fieldnames"] == ["data"] and answer["typedefs"][0]["examples"] == ["False"]


async def test_parameters_are_set_as_json_or_as_a_string(rosapi: Rosapi) -> None:
    for given, kept in (("[1,2]", "[1,2]"), ("hello there", '"hello there"')):
        await ask(rosapi, "/rosapi/set_param", json.dumps({"name": "/x", "value": given}))
        assert await ask(rosapi, "/rosapi/get_param", '["/x"]') == {"value": kept}


@pytest.mark.parametrize(
    ("service", "values", "words"),
    [
        ("/rosapi/get_ros_version", "{}", "a service of ROS 2; this robot has ROS 1"),
        ("/rosapi_node/get_ros_version", "{}", "a service of ROS 2; this robot has ROS 1"),
        ("/rosapi/nonsense", "{}", "rosapi has no service '/rosapi/nonsense'"),
        ("/rosapi/get_param", '{"name":"/secret"}', "denied by [Parameters] (site.ini:9)"),
        ("/rosapi/delete_param", '{"name":"/gains"}', "denied by [Parameters] (site.ini:9)"),
        ("/rosapi/topic_type", '{"topic":7}', "Expected `str`, got `int` - at `$.topic`"),
        ("/rosapi/topic_type", "[" * 100_000, "arguments of a call of rosapi"),
        ("/rosapi/message_details", '{"type":"own/Type"}', "does not know this message type"),
        ("/rosapi/service_request_details", '{"type":"own/Type"}', "does not know this service type"),
    ],
)
async def test_a_call_without_an_answer_fails_in_words(
    rosapi: Rosapi, service: str, values: str, words: str
) -> None:
    with pytest.raises((PeerError, MasterDenialError)) as caught:
        await ask(rosapi, service, values)
    assert words in str(caught.value)


def test_other_services_are_not_answered(rosapi: Rosapi) -> None:
    assert rosapi.answer(CallOfService("/base/reset", 1, Raw(b"{}"))) is None


async def test_the_sight_of_a_node_is_what_the_master_answers_it() -> None:
    async with door_world() as world:
        world.master.answers["getSystemState"] = [[["/odom", ["/base"]]], [], [["/reset", ["/base"]]]]
        world.master.answers["getTopicTypes"] = [["/odom", "nav_msgs/Odometry"]]
        client = await world.client()
        client.send({"op": "call_service", "service": "/rosapi/topics", "id": 1})
        assert (await client.next())["values"] == {"topics": ["/odom"], "types": ["nav_msgs/Odometry"]}
        world.master.denials["getSystemState"] = "denied by [Commands] getSystemState (site.ini:4)"
        client.send({"op": "call_service", "service": "/rosapi/nodes", "id": 2})
        refusal = await client.next()
        assert refusal["values"]["message"] == "denied by [Commands] getSystemState (site.ini:4)"
        before = asyncio.get_running_loop().time()
        client.send({"op": "call_service", "service": "/rosapi/get_ros_version", "id": 3})
        assert (await client.next())["result"] is False
        assert asyncio.get_running_loop().time() == before
