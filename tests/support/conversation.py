"""Conversations with RVMaster as text: a line is what somebody does, and what follows from it are lines, too.

What is done (`Conversation.say`):

    10.0.0.1 /talker registerPublisher /chatter std_msgs/String    a call of the Master API, made at that host
    10.0.0.1 /talker:2 registerPublisher /chatter ...               the same by a second life of the node
    10.0.0.2 /listener requestTopic /chatter of /talker             a call of another node's API
    own /rosout registerPublisher /rosout_agg rosgraph_msgs/Log     a call of the appliance's own node
    /talker dies | /talker answers                                  and is looked at
    policy NAME                                                     that policy comes into force
    ROSMaster starts anew | a relay starts anew

What follows: the effects, one a line, in the order in which they are carried out; a denial is `deny: why`. Nodes are
written by their names (a second life as `/talker:2`), also where a node is told an URI. What only keeps state for the
next life of control is left out. No socket is opened, and nothing has a random name, so that the text of a
conversation is what a formal model of RVMaster can be compared with.
"""

import shlex
from typing import Any, cast

from appliance.channel import messages
from appliance.master.endpoints.node_api import NodeApi
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.endpoints.traffic import Carried
from appliance.master.graph.effects import (
    CloseNode,
    DropCalls,
    Effect,
    Place,
    PlaceGrant,
    PlaceNode,
    PutBack,
    Record,
    RevokeGrant,
    TakeBack,
    TellNode,
    Withdraw,
    WithdrawNode,
)
from appliance.master.graph.registry import Incarnation
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
    "lookupService": "R",
}
_WORDS = {
    Place: "place",
    PlaceNode: "place",
    PlaceGrant: "grant",
    Withdraw: "withdraw",
    WithdrawNode: "withdraw",
    RevokeGrant: "revoke",
    CloseNode: "close",
    DropCalls: "drop what waits for",
}


class Conversation:
    """RVMaster and all who speak with it; `policies` are texts by the names that `policy NAME` has."""

    def __init__(self, parts: ControlParts, **policies: str) -> None:
        self.parts = parts
        self._policies = policies
        self._names: dict[str, str] = {}  # of incarnations, by their keys

    async def say(self, line: str) -> list[str]:
        """What follows from one line."""
        self.parts.enactor.noted.clear()
        said = shlex.split(line)
        match said:
            case ["policy", name]:
                self.parts.reload(self._policies[name])
                answers: list[str] = []
            case ["ROSMaster", "starts", "anew"]:
                self.parts.hidden.restart()
                await self.parts.round()
                answers = []
            case ["a", "relay", "starts", "anew"]:
                answers = self._relay_starts()
            case [name, "dies" | "answers" as does]:
                node, gone = self._node(name), self.parts.clients.gone
                (gone.add if does == "dies" else gone.discard)(node.name)
                await self.parts.look(node)
                answers = []
            case [host, name, "requestTopic", topic, "of", publisher]:
                target = self._node(publisher)
                asked = self.parts.ask("requestTopic", name, topic, [["TCPROS"]], host=host, target=target)
                answers = _denial(await asked)
            case [host, name, method, *rest]:
                call = self._call(host, name, method, rest)
                own = host == "own"
                at = "127.0.0.1" if own else host
                answers = _denial(await self.parts.ask(*call, host=at, own=own))
                self._names |= {
                    node.key: name
                    for node in self.parts.registry.all()
                    if node.key not in self._names and node.name == call[1]
                }
            case _:
                raise ValueError(f"nobody says {line!r}")
        await self.parts.settle()
        shown = [self._shown(effect) for effect in self.parts.enactor.noted]
        return [*answers, *filter(None, shown)]

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
                    parameters.append(int(next(given)))
                case _:
                    parameters.append(next(given))
        return (method, name, *parameters)

    def _node(self, name: str) -> Incarnation:
        keys = [key for key, known in self._names.items() if known == name]
        node = self.parts.registry.by_key(keys[0])
        assert node is not None
        return node

    def _relay_starts(self) -> list[str]:
        """As control does when it gets the link of a new relay."""
        parts, link = self.parts, _Link()
        relay = RelayControl(
            parts.registry,
            parts.grants,
            cast(Any, _Ports()),
            idle(NodeApi),
            idle(Carried),
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
        """One line; an empty one for what only the store is told."""
        name = self._names[effect.node.key] if hasattr(effect, "node") else ""
        match effect:
            case TellNode(_, call):
                text = f"tell {name} {call.method} {' '.join(self._value(one) for one in call.parameters)}"
            case Place(_, kind, resource) | Withdraw(_, kind, resource):
                text = f"{_WORDS[type(effect)]} {name} {kind} {resource}"
            case PlaceNode() | WithdrawNode() | CloseNode() | DropCalls():
                text = f"{_WORDS[type(effect)]} {name}"
            case PlaceGrant(row) | RevokeGrant(row):
                whose = self._names[row.key]
                text = f"{_WORDS[type(effect)]} {row.caller_id} of {row.host} {row.kind} {row.resource} of {whose}"
            case PutBack(_, registrations):
                text = f"ROSMaster: {name} has {', '.join(f'{one.kind} {one.resource}' for one in registrations)} again"
            case TakeBack(_, one):
                text = f"ROSMaster: {name} has {one.kind} {one.resource} no more"
            case Record():
                text = f"record {effect.event}: {effect.caller_id} {effect.category} {effect.resource}"
            case _:
                text = ""
        return text

    def _value(self, value: Value) -> str:
        if isinstance(value, list):
            return f"[{', '.join(self._value(one) for one in value)}]"
        nodes = self.parts.registry.all()
        known = {
            uri: self._names[one.key] for one in nodes for uri in (one.outer_uri(one.told), one.api_text)
        }
        return known.get(str(value), str(value))


class _Ports:
    """As `Places`: a socket for each port that is none."""

    def socket(self, port: int) -> "_Ports":
        """As `Places`."""
        self._port = port
        return self

    def fileno(self) -> int:
        """As a socket's."""
        return self._port


class _Monitors:
    """No specifications are in force."""

    def statement(self, _relay: int) -> messages.SpecificationsStated:
        """As `Monitors`."""
        return messages.SpecificationsStated(0, b"", {}, restarted=False)


class _Link:
    """As the channel to a relay: what it was told."""

    def __init__(self) -> None:
        self.told: list[messages.Message] = []

    def attach(self, *_given: object) -> None:
        """As `Channel`."""

    def send(self, message: messages.Message, _descriptors: tuple[int, ...] = (), **_when: bool) -> None:
        """As `Channel`."""
        if not isinstance(message, messages.StateBegan | messages.StateEnded | messages.SpecificationsStated):
            self.told.append(message)


def _denial(answer: Value) -> list[str]:
    assert isinstance(answer, list)
    return [] if answer[0] == 1 else [f"deny: {answer[1]!s}"]
