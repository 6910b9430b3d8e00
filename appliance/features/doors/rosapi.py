"""Answer the services of rosapi from the graph that the policy lets the door see.

`get_ros_version` fails: it belongs to ROS 2, and clients call it to find out which ROS this is. A call that the
policy denies fails with the master's words.
"""

from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Protocol
from urllib.parse import urlsplit

import msgspec
from msgspec import Raw, Struct

from appliance.features.doors.client_requests import CallOfService
from appliance.features.doors.known_types import KnownTypes
from appliance.features.doors.message_writer import Now
from appliance.features.doors.surroundings import DoorSurroundings, VisibleGraph
from roswire.definitions import Definitions
from roswire.errors import ProtocolError, quote
from roswire.message_text import PRIMITIVES, MessageDefinition
from roswire.node import RosNode
from roswire.xmlrpc import Value

_PREFIX = "/rosapi/"
_ACTION_TOPICS = ("cancel", "feedback", "goal", "result", "status")
_TIME_TYPES = ("time", "duration")
_EXAMPLES = {"bool": "False", "string": "", "float32": "0.0", "float64": "0.0"}


class Sight(Protocol):
    """The part of the system that an identity may see. Methods raise `RosError` for a denial."""

    async def graph(self) -> VisibleGraph: ...

    async def service_header(self, service: str) -> Mapping[str, str]: ...

    async def service_uri(self, service: str) -> str: ...

    async def parameter(self, call: str, *arguments: Value) -> Value:
        """Make a call of the parameter API other than `setParam`."""

    async def set_parameter(self, name: str, value: Value) -> None: ...

    def time(self) -> Now: ...


class Outlook(Protocol):
    """The topics and services that the identity may see, with their types."""

    async def look(self) -> DoorSurroundings: ...

    async def service_types(self) -> Mapping[str, str]: ...


class MasterSight:
    """The answers of the master, which the policy decides."""

    def __init__(self, node: RosNode, now: Callable[[], Now]) -> None:
        self._node = node
        self._now = now

    async def graph(self) -> VisibleGraph:
        state = await self._node.master("getSystemState")
        if not isinstance(state, list) or len(state) != 3:
            raise ProtocolError("the master gave no valid answer to getSystemState")
        types = await self._node.master("getTopicTypes")
        publishers, subscribers, services = map(_rows, state)
        return VisibleGraph(
            publishers, subscribers, services, types={name: str(kind) for name, kind in _pairs(types)}
        )

    async def service_header(self, service: str) -> Mapping[str, str]:
        return await self._node.probe_service(service)

    async def service_uri(self, service: str) -> str:
        return str(await self._node.master("lookupService", service))

    async def parameter(self, call: str, *arguments: Value) -> Value:
        return await self._node.master(call, *arguments)

    async def set_parameter(self, name: str, value: Value) -> None:
        await self._node.set_parameter(name, value)

    def time(self) -> Now:
        return self._now()


def _pairs(value: Value) -> list[tuple[str, Value]]:
    rows = value if isinstance(value, list) else []
    return [
        (row[0], row[1])
        for row in rows
        if isinstance(row, list) and len(row) == 2 and isinstance(row[0], str)
    ]


def _rows(value: Value) -> dict[str, list[str]]:
    return {name: [str(node) for node in nodes] for name, nodes in _pairs(value) if isinstance(nodes, list)}


Json = bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"] | None


class _Arguments(Struct):
    topic: str = ""
    type: str = ""
    service: str = ""
    node: str = ""
    name: str = ""
    value: str = ""
    default: str = ""


_Answer = Callable[[_Arguments], Awaitable[Mapping[str, Json] | Mapping[str, Value]]]


class Rosapi:
    """The services of one door."""

    def __init__(self, sight: Sight, types: KnownTypes, outlook: Outlook) -> None:
        self._sight = sight
        self._types = types
        self._outlook = outlook
        self._answers: dict[str, tuple[tuple[str, ...], _Answer]] = {
            "topics": ((), self._topics),
            "topics_and_raw_types": ((), self._topics_and_raw_types),
            "topics_for_type": (("type",), self._topics_for_type),
            "topic_type": (("topic",), self._topic_type),
            "publishers": (("topic",), self._publishers),
            "subscribers": (("topic",), self._subscribers),
            "services": ((), self._services),
            "services_for_type": (("type",), self._services_for_type),
            "service_type": (("service",), self._service_type),
            "service_node": (("service",), self._service_node),
            "service_providers": (("service",), self._service_providers),
            "service_host": (("service",), self._service_host),
            "nodes": ((), self._nodes),
            "node_details": (("node",), self._node_details),
            "action_servers": ((), self._action_servers),
            "message_details": (("type",), self._message_details),
            "service_request_details": (("type",), self._request_details),
            "service_response_details": (("type",), self._response_details),
            "get_param": (("name", "default"), self._get_param),
            "set_param": (("name", "value"), self._set_param),
            "has_param": (("name",), self._has_param),
            "search_param": (("name",), self._search_param),
            "delete_param": (("name",), self._delete_param),
            "get_param_names": ((), self._param_names),
            "get_time": ((), self._time),
        }

    def answer(self, request: CallOfService) -> Awaitable[Raw] | None:
        if request.service.endswith("/get_ros_version"):
            return _fail("get_ros_version is a service of ROS 2; this robot has ROS 1")
        if not request.service.startswith(_PREFIX):
            return None
        row = self._answers.get(request.service.removeprefix(_PREFIX))
        if row is None:
            return _fail(f"rosapi has no service {quote(request.service)}")
        return self._answer(*row, bytes(request.values))

    async def _answer(self, fields: tuple[str, ...], answer: _Answer, values: bytes) -> Raw:
        try:
            if values.lstrip().startswith(b"["):
                given = msgspec.json.decode(values, type=list[Raw])
                values = msgspec.json.encode(dict(zip(fields, given, strict=False)))
            arguments = msgspec.json.decode(values, type=_Arguments)
        except (ValueError, RecursionError) as error:
            raise ProtocolError(f"arguments of a call of rosapi: {error}") from None
        return Raw(msgspec.json.encode(await answer(arguments)))

    # --- topics ---

    async def _topics(self, _given: _Arguments) -> dict[str, list[str]]:
        graph = await self._sight.graph()
        return {"topics": list(graph.topics), "types": [graph.types.get(topic, "") for topic in graph.topics]}

    async def _topics_and_raw_types(self, given: _Arguments) -> Mapping[str, Json]:
        found = await self._topics(given)
        texts = {seen.topic: seen.definition for seen in (await self._outlook.look()).topics}
        # As in rosapi, a type that is not known has no text.
        return found | {"typedefs_full_text": [texts.get(topic, "") for topic in found["topics"]]}

    async def _topics_for_type(self, given: _Arguments) -> Mapping[str, Json]:
        graph = await self._sight.graph()
        return {"topics": [topic for topic in graph.topics if graph.types.get(topic) == given.type]}

    async def _topic_type(self, given: _Arguments) -> Mapping[str, Json]:
        return {"type": (await self._sight.graph()).types.get(given.topic, "")}

    async def _publishers(self, given: _Arguments) -> Mapping[str, Json]:
        return {"publishers": (await self._sight.graph()).publishers.get(given.topic, [])}

    async def _subscribers(self, given: _Arguments) -> Mapping[str, Json]:
        return {"subscribers": (await self._sight.graph()).subscribers.get(given.topic, [])}

    # --- services and nodes ---

    async def _services(self, _given: _Arguments) -> Mapping[str, Json]:
        return {"services": sorted((await self._sight.graph()).services)}

    async def _services_for_type(self, given: _Arguments) -> Mapping[str, Json]:
        types = await self._outlook.service_types()  # of services that the door may not use, there is none
        return {"services": sorted(service for service, kind in types.items() if kind == given.type)}

    async def _service_type(self, given: _Arguments) -> Mapping[str, Json]:
        return {"type": (await self._sight.service_header(given.service)).get("type", "")}

    async def _service_node(self, given: _Arguments) -> Mapping[str, Json]:
        nodes = (await self._sight.graph()).services.get(given.service, [])
        return {"node": nodes[0] if nodes else ""}

    async def _service_providers(self, given: _Arguments) -> Mapping[str, Json]:
        return {"providers": (await self._sight.graph()).services.get(given.service, [])}

    async def _service_host(self, given: _Arguments) -> Mapping[str, Json]:
        return {"host": urlsplit(await self._sight.service_uri(given.service)).hostname or ""}

    async def _nodes(self, _given: _Arguments) -> Mapping[str, Json]:
        graph = await self._sight.graph()
        tables = (graph.publishers, graph.subscribers, graph.services)
        return {"nodes": sorted({node for table in tables for nodes in table.values() for node in nodes})}

    async def _node_details(self, given: _Arguments) -> Mapping[str, Json]:
        graph = await self._sight.graph()

        def of(table: Mapping[str, Sequence[str]]) -> list[str]:
            return sorted(name for name, nodes in table.items() if given.node in nodes)

        return {
            "subscribing": of(graph.subscribers),
            "publishing": of(graph.publishers),
            "services": of(graph.services),
        }

    async def _action_servers(self, _given: _Arguments) -> Mapping[str, Json]:
        topics = {*(await self._sight.graph()).topics}
        roots = {topic.rpartition("/")[0] for topic in topics if topic.endswith("/goal")}
        return {
            "action_servers": sorted(
                root for root in roots if all(f"{root}/{part}" in topics for part in _ACTION_TOPICS)
            )
        }

    # --- types ---

    async def _message_details(self, given: _Arguments) -> Mapping[str, Json]:
        if self._types.has_message(given.type):
            return {"typedefs": typedefs(self._types.message(given.type).definitions, given.type)}
        seen = [topic for topic in (await self._outlook.look()).topics if topic.type == given.type]
        versions = {one.fingerprint: one for one in seen}
        if len(versions) > 1:
            words = " and ".join(f"{version.topic} ({version.md5sum})" for version in versions.values())
            raise ProtocolError(f"{quote(given.type)} has several definitions: {words}")
        for one in seen:
            return {"typedefs": typedefs(Definitions.from_full_text(one.type, one.definition), one.type)}
        return {"typedefs": typedefs(self._types.message(given.type).definitions, given.type)}  # raises

    async def _request_details(self, given: _Arguments) -> Mapping[str, Json]:
        definitions = self._types.service(given.type)[2]
        return {"typedefs": typedefs(definitions, definitions.service(given.type).request.name)}

    async def _response_details(self, given: _Arguments) -> Mapping[str, Json]:
        definitions = self._types.service(given.type)[2]
        return {"typedefs": typedefs(definitions, definitions.service(given.type).response.name)}

    # --- parameters and time ---

    async def _get_param(self, given: _Arguments) -> Mapping[str, Json]:
        if not await self._sight.parameter("hasParam", given.name):
            return {"value": _as_text(_as_value(given.default)) if given.default else "null"}
        return {"value": _as_text(await self._sight.parameter("getParam", given.name))}

    async def _set_param(self, given: _Arguments) -> Mapping[str, Json]:
        await self._sight.set_parameter(given.name, _as_value(given.value))
        return {}

    async def _has_param(self, given: _Arguments) -> Mapping[str, Json]:
        return {"exists": bool(await self._sight.parameter("hasParam", given.name))}

    async def _search_param(self, given: _Arguments) -> Mapping[str, Json]:
        return {"global_name": str(await self._sight.parameter("searchParam", given.name) or "")}

    async def _delete_param(self, given: _Arguments) -> Mapping[str, Json]:
        if await self._sight.parameter("hasParam", given.name):
            await self._sight.parameter("deleteParam", given.name)
        return {}

    async def _param_names(self, _given: _Arguments) -> Mapping[str, Value]:
        return {"names": await self._sight.parameter("getParamNames")}

    async def _time(self, _given: _Arguments) -> Mapping[str, Json]:
        secs, nsecs = self._sight.time()
        return {"time": {"secs": secs, "nsecs": nsecs}}


async def _fail(reason: str) -> Raw:
    raise ProtocolError(reason)


def _as_value(text: str) -> Value:
    """Return the value of a JSON text. A text that is not JSON is a string, as in rosapi."""
    try:
        value: Value = msgspec.json.decode(text)
    except (ValueError, RecursionError):
        return text
    return value


def _as_text(value: Value) -> str:
    return msgspec.json.encode(value).decode()


def typedefs(definitions: Definitions, name: str) -> list[Mapping[str, Json]]:
    found: dict[str, Mapping[str, Json]] = {}

    def add(kind: str) -> None:
        if kind in found or (kind in PRIMITIVES and kind not in _TIME_TYPES) or kind == "string":
            return
        if kind in _TIME_TYPES:
            found[kind] = _time_typedef(kind)
            return
        message = definitions.message(kind)
        found[kind] = _typedef(message)
        for field in message.fields:
            add(field.type)

    definitions.layout(name)  # raises if a type contains itself
    add(name)
    return [*found.values()]


def _typedef(message: MessageDefinition) -> Mapping[str, Json]:
    fields, constants = message.fields, sorted(message.constants, key=lambda one: one.name)
    return {
        "type": message.name,
        "fieldnames": [field.name for field in fields],
        "fieldtypes": [field.type for field in fields],
        "fieldarraylen": [(field.length or 0) if field.is_array else -1 for field in fields],
        "examples": [
            "[]" if field.is_array else _EXAMPLES.get(field.type, "0" if _is_number(field.type) else "{}")
            for field in fields
        ],
        "constnames": [constant.name for constant in constants],
        "constvalues": [str(constant.value) for constant in constants],
    }


def _is_number(kind: str) -> bool:
    return kind in PRIMITIVES and kind not in _TIME_TYPES


def _time_typedef(kind: str) -> Mapping[str, Json]:
    return {
        "type": kind,
        "fieldnames": ["secs", "nsecs"],
        "fieldtypes": ["int32", "int32"],
        "fieldarraylen": [-1, -1],
        "examples": ["0", "0"],
        "constnames": [],
        "constvalues": [],
    }
