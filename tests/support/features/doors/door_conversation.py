"""Conversations of clients with a door, in virtual time. Each line is an action, followed by the lines of its effects.

Clients, whose frames are text. The first word is the client's name; one that has not come comes first, from 10.0.0.9:

    ann > {"op": "subscribe", "topic": "/state"}        and `ann < FRAME` is what the client gets
    ann > cbor JSON | ann > bytes TEXT | ann > hex 01    binary frames; `«x*5000»` is a long text everywhere
    ann > message 1 hex 01 | ann > message 1 TEXT        of Foxglove, on channel 1
    ann > call 1 7 hex 01                                of Foxglove, call 7 of service 1
    ann leaves | ann stops reading | ann reads on | ann loses its right: REASON
    bob comes from 10.0.0.10 | vic comes to view         from another host; with the protocol of Foxglove
    a client may have {"calls": 2}                       instead of its protocol's limits

The robot's nodes, the master and time:

    /robot publishes /state std_msgs/String [latched]    and `/robot says /state {"data": "x"}`
    /robot publishes /state own/Load as int8 x|int8 y    with a definition, whose lines end with `|`
    /robot hears /cmd std_msgs/String                    and `/robot hears /cmd VALUES` is each message; type * as hex
    /robot withdraws /state | /robot ends                a topic or a service; everything
    /robot offers /brake std_srvs/SetBool VALUES         the answer, or `fails REASON`, or `never`
    /robot calls /grip std_srvs/SetBool VALUES           and `/robot gets VALUES` or `/robot fails REASON`
    the graph has {TOPIC: [TYPE, NODE], SERVICE: NODE}   as viewers of Foxglove see it
    the master answers METHOD[:NAME] VALUE               and, to its subscribers, `the master tells /a 1`
    the hosts are {NODE: HOST}                           host 0 is the robot's machine
    the operator defines {"own/Load.msg": TEXT}          in the folder of specifications
    the master takes 0.1                                 seconds for each answer
    the master denies METHOD[:NAME] REASON               until `the master grants METHOD[:NAME]`
    the policy changes                                   so that denials may have ended
    given LINE                                           another action, whose effects are not listed
    10 s pass | 20 times in 2 s: ann > {"id": {n}}       `{n}` counts from 0; equal effects are counted

The door's own calls of the master, which registers or withdraws something, are `door METHOD NAME`. After
`ann is disconnected: REASON`, the next action is in flight. An effect that comes later than its action begins with the
seconds after it. Long texts are shown by their begin and length.
"""

import asyncio
import json
import re
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import Any

import cbor2
from msgspec import Raw

from appliance.features.doors.foxglove import SUBPROTOCOLS, FoxgloveLimits
from appliance.features.doors.known_types import KnownType, KnownTypes
from appliance.features.doors.rosbridge import RosbridgeLimits
from appliance.features.doors.session import DoorSession
from appliance.features.doors.values import ValueLimits
from roswire.definitions import Definitions
from roswire.node import MessageType, NodePublication, RosNode, ServiceFailedError, ServiceType
from roswire.standard import standard_definitions
from roswire.tcpros import Body
from roswire.xmlrpc import MethodCall, Value
from tests.support.features.doors.door_world import DoorWorld, WebSocketClient

DEFINITIONS = standard_definitions().merge(
    Definitions.from_files({"own/Load.msg": "geometry_msgs/Point32 at\nfloat32 weight"})
)
_SETTLED = 0.2  # s
_FRAME = re.compile(r"(\S+ s: |)\S+ < ")
_SHOWN = 300  # characters of a text
_TYPES = KnownTypes(DEFINITIONS, ValueLimits())


class DoorConversation:
    def __init__(self, world: DoorWorld, *, foxglove: bool) -> None:
        self._world = world
        self._foxglove = foxglove
        self._clients: dict[str, WebSocketClient] = {}
        self._nodes: dict[str, RosNode] = {}
        self._published: dict[tuple[str, str], tuple[NodePublication, KnownType]] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self._seen: list[str] = []
        self._told: set[str] = set()  # clients, why their connection ended
        self._since = 0.0
        self._answer = world.master.answer
        self._graph("{}")
        world.ended = self._ended
        world.master.answer = self._answered  # type: ignore[method-assign]  # the master of the test

    async def say(self, line: str) -> list[str]:
        self._begin()
        text = re.sub(r"«(.+?)\*(\d+)»", lambda found: found[1] * int(found[2]), line)
        match = re.fullmatch(r"(\d+) times in (\S+) s: (.*)", text)
        if match is not None:
            for number in range(int(match[1])):
                await self._act(match[3].replace("{n}", str(number)))
                await asyncio.sleep(float(match[2]) / int(match[1]))
        else:
            await self._act(text)
        await asyncio.sleep(0 if " is disconnected: " in line else _SETTLED)
        for name, client in self._clients.items():
            if client.socket.close_reason and name not in self._told:
                self._told.add(name)
                self._seen.append(f"{name} is told: {client.socket.close_code} {client.socket.close_reason}")
        for one in self._world.types.take_differing():
            publishers = sorted(" ".join(part) for part in (one.earlier, one.later))
            self._seen.append(f"door reports two definitions of {one.name}: {' and '.join(publishers)}")
        return (_counted if match is None else _folded)(_without_ids(_by_client(self._seen)))

    def _begin(self) -> None:
        self._seen.clear()
        self._since = asyncio.get_running_loop().time()

    def close(self) -> None:
        for task in self._tasks:
            task.cancel()

    def _saw(self, effect: str) -> None:
        seconds = round(asyncio.get_running_loop().time() - self._since, 1)
        self._seen.append(effect if seconds <= _SETTLED else f"{seconds:g} s: {effect}")

    async def _act(self, line: str) -> None:
        match line.split(" ", 3):
            case [seconds, "s", "pass"]:
                await asyncio.sleep(float(seconds) - _SETTLED)
            case ["the", "policy", "changes"]:
                self._world.door.policy_changed()
                self._world.lookout.policy_changed()
            case ["the", "graph", "has", graph]:
                self._graph(graph)
            case ["the", "hosts", "are", hosts]:
                self._world.hosts = json.loads(hosts)
            case ["the", "operator", "defines", files]:
                self._world.types.define(Definitions.from_files(json.loads(files)))
            case ["the", "master", *_words]:
                await self._master(line.removeprefix("the master "))
            case ["a", "client", "may", limits]:
                given = json.loads(limits.removeprefix("have "))
                if self._foxglove:
                    self._world.foxglove = FoxgloveLimits(**given)
                else:
                    self._world.rosbridge = RosbridgeLimits(**given)
            case [name, verb, *words] if name.startswith("/"):
                await self._robot(name, verb, " ".join(words))
            case [name, verb, *words]:
                await self._client(name, verb, " ".join(words))
            case _:
                raise ValueError(f"unknown action: {line!r}")

    # --- clients ---

    async def _client(self, name: str, verb: str, words: str = "") -> None:
        if name not in self._clients:
            host = words.removeprefix("from ") if words.startswith("from ") else "10.0.0.9"
            subprotocols = SUBPROTOCOLS if self._foxglove or words == "to view" else ()
            client = self._clients[name] = await self._world.client(host, subprotocols=subprotocols)
            self._tasks.append(asyncio.ensure_future(self._listen(name, client)))
            if verb == ">":
                await asyncio.sleep(_SETTLED)
                self._begin()
        client = self._clients[name]
        match verb:
            case ">":
                client.send(self._frame(words))
            case "leaves":
                client.writer.close()
            case "stops":
                client.stop_reading()
            case "reads":
                client.read_on()
            case "loses":
                self._session(name).revoke(words.removeprefix("its right: "))
            case "is":
                self._session(name).disconnect(words.removeprefix("disconnected: "))
            case "comes":
                pass
            case _:
                raise ValueError(f"unknown action: {name} {verb}")

    def _session(self, name: str) -> DoorSession:
        return self._world.sessions[[*self._clients].index(name)]

    def _ended(self, session: DoorSession) -> None:
        name = [*self._clients][self._world.sessions.index(session)]
        self._saw(f"door ends {name}: {session.end}")

    async def _listen(self, name: str, client: WebSocketClient) -> None:
        while True:
            self._saw(f"{name} < {self._shown(await client.frames.get())}")

    @staticmethod
    def _frame(text: str) -> str | bytes:
        form, _, rest = text.partition(" ")
        match form:
            case "hex":
                return bytes.fromhex(rest)
            case "bytes":
                return rest.encode()
            case "cbor":
                return cbor2.dumps(json.loads(rest))
            case "message":
                channel, _, body = rest.partition(" ")
                return struct.pack("<BI", 1, int(channel)) + _bytes(body)
            case "call":
                service, call, body = rest.split(" ", 2)
                return struct.pack("<BIII", 2, int(service), int(call), 4) + b"ros1" + _bytes(body)
        return text

    def _shown(self, frame: Any) -> str:
        if not isinstance(frame, bytes):
            return _json(frame)
        if frame[0] == 1:
            subscription, stamp = struct.unpack_from("<IQ", frame, 1)
            return f"message {subscription} hex {frame[13:].hex()}" + (" without a time" if not stamp else "")
        if frame[0] == 3:
            service, call, length = struct.unpack_from("<III", frame, 1)
            return (
                f"answer {service} {call} {frame[13 : 13 + length].decode()} hex {frame[13 + length :].hex()}"
            )
        return f"hex {frame.hex()}"

    # --- the robot ---

    async def _robot(self, name: str, verb: str, words: str) -> None:
        if name not in self._nodes:
            self._nodes[name] = await self._world.robot(f"10.0.1.{len(self._nodes)}", name)
        node = self._nodes[name]
        resource, _, rest = words.partition(" ")
        kind, _, values = rest.partition(" ")
        match verb:
            case "publishes":
                latched, text = values == "latched", values.removeprefix("as ")
                definitions = DEFINITIONS
                if text != values:
                    definitions = Definitions.from_full_text(kind, text.replace("|", "\n"))
                made = MessageType.of(definitions, kind)
                publication = await node.advertise(resource, made, latched=latched, queue=100)
                known = KnownTypes(definitions, ValueLimits()).message(kind)
                self._published[name, resource] = publication, known
            case "withdraws" if (name, resource) in self._published:
                await node.unadvertise(resource)
            case "withdraws":
                await node.withdraw(resource)
            case "ends":
                await node.close()
                self._world.nodes.remove(node)
            case "says":
                publication, known = self._published[name, resource]
                publication.publish(known.codec.writer.from_json(rest.encode(), (7, 8)))
            case "hears":

                def heard(body: Body, _header: object) -> None:
                    if kind == "*" or len(body) > 1_000_000:
                        values = f"hex {bytes(body).hex()}" if kind == "*" else f"{len(body)} bytes"
                    else:
                        values = _json(_TYPES.message(kind).codec.json(body))
                    self._saw(f"{name} hears {resource} {values}")

                await node.subscribe(resource, heard)
            case "offers":
                await self._offer(node, resource, kind, values)
            case "calls":
                self._tasks.append(asyncio.ensure_future(self._call(node, resource, kind, values)))
            case _:
                raise ValueError(f"unknown action: {name} {verb!r}")

    async def _offer(self, node: RosNode, service: str, kind: str, values: str) -> None:
        request, response, _ = _TYPES.service(kind)

        async def answer(body: bytes) -> bytes:
            self._saw(f"{node.name} is asked {service} {_json(request.codec.json(body))}")
            if values == "never":
                await asyncio.sleep(36_000)
            if values.startswith("fails "):
                raise ServiceFailedError(values.removeprefix("fails "))
            return response.codec.writer.from_json(values.encode(), (7, 8))

        await node.offer(service, ServiceType.of(DEFINITIONS, kind), answer)

    async def _call(self, node: RosNode, service: str, kind: str, values: str) -> None:
        request, response, _ = _TYPES.service(kind)
        body = request.codec.writer.from_json(values.encode(), (7, 8))
        try:
            answer = await node.call_service(service, "*", body, 100.0)
        except ServiceFailedError as failure:
            self._saw(f"{node.name} fails {failure}")
        else:
            self._saw(f"{node.name} gets {_json(response.codec.json(answer))}")

    # --- the master ---

    async def _answered(self, call: MethodCall) -> Value:
        method, (caller, *params) = call.method, [str(param) for param in call.params]
        name = next((param for param in params if param.startswith("/")), "")
        if caller.startswith(self._world.node.name) and re.match(
            r"(un)?(register|subscribe)|(set|delete)Param", method
        ):
            value = f" {json.dumps(call.params[-1])}" if method == "setParam" else ""
            self._saw(f"door {method} {name}{value}")
        one, master = f"{method}:{name}", self._world.master
        if one in master.denials or one in master.answers:
            return [-1, master.denials[one], 0] if one in master.denials else [1, "", master.answers[one]]
        return await self._answer(call)

    async def _master(self, line: str) -> None:
        world = self._world
        verb, _, words = line.partition(" ")
        first, _, rest = words.partition(" ")
        match verb:
            case "denies":
                world.master.denials[first] = rest
            case "grants":
                del world.master.denials[first]
            case "tells":
                await world.master.call(world.node.uri, "paramUpdate", first, json.loads(rest))
            case "takes":
                world.master.before_answer = lambda _call: asyncio.sleep(float(first))
            case "answers":
                world.master.answers[first] = json.loads(rest)
            case _:
                raise ValueError(f"unknown action of the master: {line!r}")

    def _graph(self, text: str) -> None:
        graph = json.loads(text)
        topics = {name: one for name, one in graph.items() if isinstance(one, list)}
        services: list[Any] = [[name, [one]] for name, one in graph.items() if isinstance(one, str)]
        publishers: list[Any] = [[topic, [node]] for topic, (_kind, node) in topics.items()]
        self._world.master.answers["getSystemState"] = [publishers, [["/cmd_vel", ["/base"]]], services]
        self._world.master.answers["getTopicTypes"] = [
            [topic, kind] for topic, (kind, _node) in topics.items()
        ]


def _by_client(effects: list[str]) -> Iterator[str]:
    """Order frames that several clients get at one time by the clients, because the door serves those in any order."""
    for _time, same in groupby(effects, key=lambda one: match[1] if (match := _FRAME.match(one)) else one):
        yield from sorted(same, key=lambda one: one.split(" < ")[0])


def _without_ids(effects: Iterable[str]) -> list[str]:
    """Join each status with the same one without an id, for clients that show only such."""
    joined: list[str] = []
    for effect in effects:
        if joined and effect != joined[-1] and effect == re.sub(r', "id": [^,]*}$', "}", joined[-1]):
            joined[-1] += " and without an id"
        else:
            joined.append(effect)
    return joined


def _counted(effects: list[str]) -> list[str]:
    return [f"{one} ({times} times)" if times > 1 else one for one, times in Counter(effects).items()]


def _folded(effects: list[str]) -> list[str]:
    """Show the first of effects that are equal but for time, and of the door's calls that differ by a number."""
    firsts: dict[str, str] = {}

    def first(effect: str) -> str:
        kind = re.sub(r"^[0-9.]+ s: ", "", effect)
        return firsts.setdefault(re.sub(r"\d+", "", kind) if kind.startswith("door ") else kind, effect)

    return _counted([first(effect) for effect in effects])


def _bytes(text: str) -> bytes:
    return bytes.fromhex(text.removeprefix("hex ")) if text.startswith("hex ") else text.encode()


def _json(value: Any) -> str:
    given = json.loads(bytes(value)) if isinstance(value, Raw) else value
    return json.dumps(_short(given), ensure_ascii=False)


def _short(value: Any) -> Any:
    match value:
        case {"bytes": bytes(body), "nsecs": nanoseconds}:  # of cbor-raw
            return value | {"bytes": f"hex {body.hex()}", "nsecs": round(nanoseconds, -8)}
        case dict():
            return {name: _short(one) for name, one in value.items()}
        case [first, second, *others] if len(others) > 20:
            return [first, second, f"… {len(value)}"]
        case list():
            return [_short(one) for one in value]
        case str() if len(value) > _SHOWN:
            return f"{value[:40]} … {len(value)}"
    return value
