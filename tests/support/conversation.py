"""Conversations with RVMaster as text: each line is an action, followed by the lines of its effects.

Actions (`Conversation.say`):

    10.0.0.1 /talker registerPublisher /chatter std_msgs/String    a call of the Master API, made at that host
    10.0.0.1 /talker:2 registerPublisher /chatter ...               the same by a second life of the node
    10.0.0.2 /listener requestTopic /chatter of /talker             a call of another node's API
    own /rosout registerPublisher /rosout_agg rosgraph_msgs/Log     a call of the appliance's own node
    /talker dies | /talker is silent | /talker answers              and is checked
    /talker misses the list of /chatter                             its delivery failed
    policy NAME | policy NAME, NAME                                 put that policy in force, or several at once
    host 10.0.0.1 is expelled                                       revoke everything that its nodes have
    `ROSMaster starts anew` | `a relay starts anew`                 the ROS master or a relay restarts
    a round                                                         of the reconcile loop
    `ROSMaster has /talker publication /chatter of /other`          a registration that control has not made
    state                                                           what control and the ROS master have
    given LINE                                                      another action, whose effects are not listed

Effects follow, one per line, in the order in which they are carried out; a denial is `deny: reason`, the answer to a
question `answer: value`, a withheld update `withhold`. Nodes are written by name (a second incarnation as
`/talker:2`), also for the URIs of their proxy endpoints; `/talker itself` is the node's own URI.
Effects that only store state for a restart of control are left out. No socket is opened and no name is random, so a
formal model of RVMaster can be compared with the text.
"""

import ipaddress
import json
import shlex
from collections.abc import Iterable
from typing import Any, cast

from appliance.channel import messages
from appliance.master.endpoints.node_api import NodeApiClient
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.effects import (
    CloseNode,
    DropCalls,
    Effect,
    NodeCall,
    PlaceGrant,
    PlaceNode,
    PlaceResource,
    RegisterAtMaster,
    RevokeGrant,
    TellNode,
    UnregisterAtMaster,
    WithdrawNode,
    WithdrawResource,
    WriteRecord,
)
from appliance.master.graph.registry import Incarnation, Kind
from appliance.specifications.allocation import Allocation
from roswire.xmlrpc import Value
from tests.support.control_parts import ControlParts
from tests.support.idle import idle

# The parameters of calls after the caller's name: R a resource, V a value, A the node's API, S that of its service.
_SHAPES = {
    "registerPublisher": "RVA",
    "registerSubscriber": "RVA",
    "registerService": "RSA",
    "unregisterPublisher": "RA",
    "unregisterSubscriber": "RA",
    "unregisterService": "RS",
    "subscribeParam": "AR",
    "unsubscribeParam": "AR",
    "setParam": "RV",
    "deleteParam": "R",
    "getPublishedTopics": "R",
    "getSystemState": "",
    "getTopicTypes": "",
    "lookupNode": "R",
    "lookupService": "R",
    "requestTopic": "R",
}
_QUESTIONS = {"getPublishedTopics", "getSystemState", "getTopicTypes", "lookupNode", "lookupService"}
_REGISTER = {Kind.PUBLICATION: "registerPublisher", Kind.SUBSCRIPTION: "registerSubscriber"}
_WORDS = {
    PlaceResource: "place",
    PlaceNode: "place",
    PlaceGrant: "grant",
    WithdrawResource: "withdraw",
    WithdrawNode: "withdraw",
    RevokeGrant: "revoke",
    CloseNode: "close",
    DropCalls: "drop what waits for",
}


class Conversation:
    """RVMaster and its clients; `policies` maps the names in `policy NAME` to texts."""

    def __init__(self, parts: ControlParts, **policies: str) -> None:
        self.parts = parts
        self._policies = policies
        self._names: dict[str, str] = {}  # of incarnations, by their keys

    async def say(self, line: str) -> list[str]:
        """Return the effects of one line."""
        given = line.removeprefix("given ")
        effects = await self._effects(given)
        return effects if line == given else []

    async def _effects(self, line: str) -> list[str]:
        self.parts.enactor.noted.clear()
        self.parts.records.events.clear()
        said = shlex.split(line)
        answers = (
            await self._call_by(said) if len(said) > 2 and said[2] in _SHAPES else await self._event(said)
        )
        await self.parts.settle()
        shown = [self._shown(effect) for effect in self.parts.enactor.noted]
        denied = [resource for event, resource in self.parts.records.events if event == "deny"]
        withheld = denied[1:] if answers and answers[0].startswith("deny: ") else denied
        return [*answers, *filter(None, shown), *(f"withhold {key}" for key in withheld)]

    async def _call_by(self, said: list[str]) -> list[str]:
        """Make a call; return its denial, or the answer to a question."""
        host, name, method, *rest = said
        own = host == "own"
        if method == "requestTopic":
            topic, _of, publisher = rest
            target = self._node(publisher)
            return _denial(await self.parts.ask(method, name, topic, [["TCPROS"]], host=host, target=target))
        call = self._call(host, name, method, rest)
        answer = await self.parts.ask(*call, host="127.0.0.1" if own else host, own=own)
        self._names |= {
            node.key: "".join([node.name, *name.partition(":")[1:]])
            for node in self.parts.registry.all()
            if node.key not in self._names
        }
        assert isinstance(answer, list)
        if method in _QUESTIONS and answer[0] == 1:
            return [f"answer: {self._value(answer[1])}: {self._value(answer[2])}"]
        if method in _QUESTIONS and answer[0] == -1:
            return [f"answer: {answer[1]!s}"]
        return _denial(answer)

    async def _event(self, said: list[str]) -> list[str]:
        """Apply an event that is not a call; return the lines to show beside its effects."""
        parts = self.parts
        match said:
            case ["state"]:
                return self._state()
            case ["a", "relay", "starts", "anew"]:
                return self._relay_starts()
            case ["policy", *names]:
                for name in names:
                    parts.reload(self._policies[name.rstrip(",")])
            case ["host", host, "is", "expelled"]:
                expelled = parts.revocation.expel(ipaddress.ip_address(host), "the host was expelled")
                parts.enactor.carry_out(expelled)
            case ["ROSMaster", "starts", "anew"]:
                parts.hidden.restart()
                await parts.round()
            case ["a", "round"]:
                await parts.round()
            case ["ROSMaster", "has", name, kind, resource, "of", owner]:
                uri = parts.faces.inner_uri(self._node(owner))
                await parts.hidden.call(_REGISTER[Kind(kind)], name, resource, "type", uri)
            case [name, *happening]:
                await self._node_event(self._node(name), happening)
        return []

    async def _node_event(self, node: Incarnation, happening: list[str]) -> None:
        """Apply an event to a node, and have control check the node."""
        match happening:
            case ["misses", "the", "list", "of", topic]:
                missed = NodeCall("publisherUpdate", (topic, []))
                self.parts.watchlist.could_not_tell(node, missed, "it does not answer")
            case ["dies"] | ["is", "silent"] | ["answers"]:
                clients = self.parts.clients
                for names, word in ((clients.gone, "dies"), (clients.silent, "silent")):
                    (names.add if happening[-1] == word else names.discard)(node.name)
                await self.parts.look(node)
            case _:
                raise ValueError(f"unknown action: {' '.join(happening)!r}")

    def _state(self) -> list[str]:
        """Return the registrations and grants of all nodes, and the registrations at `rosmaster`."""
        nodes, parts = self._names, self.parts
        found = [
            f"{nodes[one.key]} is {one.life}: {_listed(one.registrations)}"
            + (f"; revoked: {_listed(one.shelf)}" if one.shelf else "")
            for one in parts.registry.all()
        ]
        found += [
            f"{row.caller_id} of {row.host} has {row.kind} {row.resource} of {nodes[row.key]}"
            for row in parts.grants.all()
        ]
        return found + [
            f"ROSMaster: {kind} {resource} of {', '.join(map(self._owner, uris))}"
            for kind, table in parts.hidden.tables.items()
            for resource, uris in table.items()
            if uris
        ]

    def _owner(self, name: str) -> str:
        """Return the node that `rosmaster` has under this name."""
        node = self.parts.faces.by_inner_uri(self.parts.hidden.nodes[name])
        return name if node is None else self._names[node.key]

    def _call(self, host: str, name: str, method: str, rest: list[str]) -> tuple[Any, ...]:
        name, _, life = name.partition(":")
        given, parameters = iter(rest), list[Value]()
        for shape in _SHAPES[method]:
            match shape:
                case "A":
                    parameters.append(f"http://{host}:{40_000 + int(life or 1)}/")
                case "S":
                    parameters.append(f"rosrpc://{host}:{next(given)}")
                case "V" if method == "setParam":
                    parameters.append(json.loads(next(given)))
                case _:
                    parameters.append(next(given))
        return (method, name, *parameters)

    def _node(self, name: str) -> Incarnation:
        keys = [key for key, known in self._names.items() if known == name]
        node = self.parts.registry.by_key(keys[0])
        assert node is not None
        return node

    def _relay_starts(self) -> list[str]:
        """Restate the nodes, as control does when it gets the link of a new relay."""
        parts, link = self.parts, _Link()
        relay = RelayControl(
            parts.registry,
            parts.grants,
            cast(Any, _Ports()),
            idle(NodeApiClient),
            idle(RelayTraffic),
            allocation=Allocation(1),
            policy=lambda: parts.current,
            monitors=cast(Any, _Monitors),
            broken=lambda _node: None,
            own_header=None,
            own_call=cast(Any, None),
        )
        relay.attach(0, cast(Any, link))
        parts.enactor.carry_out(parts.graph.tell_everybody(lambda _topic: True))
        return [self._stated(message) for message in link.told]

    # --- as text ---

    def _stated(self, message: messages.Message) -> str:
        match message:
            case messages.NodePlaced(key, _name, host):
                return f"relay: {self._names[key]} is at {host}"
            case messages.PublicationPlaced(key, topic) | messages.ServicePlaced(key, topic):
                return f"relay: {self._names[key]} has {topic}"
            case messages.GrantInstalled(key, resource, host, name) | messages.ClientGranted(
                key, resource, host, name
            ):
                return f"relay: {name} of {host} may have {resource} of {self._names[key]}"
        return f"relay: {type(message).__name__}"

    def _shown(self, effect: Effect) -> str:
        """Return one line; empty for changes of the store alone."""
        name = self._names[effect.node.key] if hasattr(effect, "node") else ""
        match effect:
            case TellNode(_, call):
                text = f"tell {name} {call.method} {' '.join(self._value(one) for one in call.parameters)}"
            case PlaceResource(_, kind, resource) | WithdrawResource(_, kind, resource):
                text = f"{_WORDS[type(effect)]} {name} {kind} {resource}"
            case PlaceNode() | WithdrawNode() | CloseNode() | DropCalls():
                text = f"{_WORDS[type(effect)]} {name}"
            case PlaceGrant(row) | RevokeGrant(row):
                whose = self._names[row.key]
                text = f"{_WORDS[type(effect)]} {row.caller_id} of {row.host} {row.kind} {row.resource} of {whose}"
            case RegisterAtMaster(_, one):
                text = f"ROSMaster: {name} has {one.kind} {one.resource}"
            case UnregisterAtMaster(_, one):
                text = f"ROSMaster: {name} has {one.kind} {one.resource} no more"
            case WriteRecord():
                text = f"record {effect.event}: {effect.caller_id} {effect.category} {effect.resource}"
            case _:
                text = ""
        return text

    def _value(self, value: Value) -> str:
        if isinstance(value, list):
            return f"[{', '.join(self._value(one) for one in value)}]"
        text = str(value)
        for one in self.parts.registry.all():
            name = self._names[one.key]
            for uri in (one.outer_uri(one.told), f"rosrpc://{one.told}:{one.relay_port}"):
                text = text.replace(uri, name)
            text = text.replace(one.api_text, f"{name} itself")
        return text


class _Ports:
    """`Places` without real ports."""

    def socket(self, port: int) -> "_Ports":
        self._port = port
        return self

    def fileno(self) -> int:
        return self._port


class _Monitors:
    """Monitors without a specification in force."""

    def statement(self, _relay: int) -> messages.SpecificationsStated:
        return messages.SpecificationsStated(0, b"", {}, restarted=False)


class _Link:
    """A channel to a relay that keeps its messages."""

    def __init__(self) -> None:
        self.told: list[messages.Message] = []

    def attach(self, *_given: object) -> None:
        """Do nothing."""

    def send(self, message: messages.Message, _descriptors: tuple[int, ...] = (), **_when: bool) -> None:
        if not isinstance(message, messages.StateBegan | messages.StateEnded | messages.SpecificationsStated):
            self.told.append(message)


def _listed(registrations: Iterable[tuple[Kind, str]]) -> str:
    return ", ".join(f"{kind} {resource}" for kind, resource in registrations) or "nothing"


def _denial(answer: Value) -> list[str]:
    assert isinstance(answer, list)
    return [f"deny: {answer[1]!s}"] if answer[0] == 0 else []
