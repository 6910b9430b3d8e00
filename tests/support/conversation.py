"""Conversations with RVMaster as text: each line is an action, followed by the lines of its effects.

Calls, made at a host (`own`: by the appliance's own node):

    10.0.0.1 /talker registerPublisher /chatter std_msgs/String    a call of the Master API
    10.0.0.1 /talker:2 registerPublisher /chatter ...               the same by a second life of the node
    10.0.0.2 /listener requestTopic /chatter of /talker             a call of another node's API
    10.0.0.2 /tool multicall setParam /a 1 | deleteParam /b         several calls in one request
    10.0.0.2 calls getPid ["/tool"]                                 any call, with all its parameters as JSON
    begin 10.0.0.2 /tool setParam /a 1                              a call that the conversation does not wait for

Events:

    /talker dies | /talker is silent | /talker answers              and is checked
    /talker misses the list of /chatter                             its delivery failed
    /ear loses its connection for /chatter                          and is checked
    /ear is forgotten                                               as a lost node that makes room
    nodes may be silent for 60 s                                    before they are lost; otherwise 0 s
    policy NAME | policy NAME, NAME                                 put that policy in force, or several at once
    host 10.0.0.1 is expelled                                       revoke everything that its nodes have
    `ROSMaster starts anew` | `a relay starts anew`                 the ROS master or a relay restarts
    `ROSMaster is slow` | `ROSMaster answers`                       its answers wait until then
    `ROSMaster stops`                                               until a round
    a round                                                         of the reconcile loop
    `registering calls wait` | `registering calls go on`            after their decision, for the ports of their node
    `ROSMaster has /talker publication /chatter of /other`          a registration that control has not made
    state                                                           what control and the ROS master have
    given LINE                                                      another action, whose effects are not listed

Effects follow, one per line. First come the answers of calls: a denial as `deny CATEGORY RESOURCE: reason`, with the
reason in the record below it if no rule decides and the caller gets less, another failure as `refused: reason`, an
error of the caller as `error: reason`, the answer to a question as `answer: value`. Then come `record malformed`,
`record limit exceeded` and `record would deny`, the effects in the order in which they are carried out, and last, as
`withhold`, the denied resources that a caller or node does not get. Nodes are written by name (a second incarnation
as `/talker:2`), even for the URIs of their proxy endpoints; `/talker itself` is the node's own URI. Effects that only
store state for a restart of control are left out. No socket is opened and no name is random, so a formal model of
RVMaster can be compared with the text.

A file has policies (`policy NAME`, or `policy NAME like OTHER` for more sections, with indented lines), and then
conversations (`# title`). A file that begins with `only answers` lists all answers and no other effects.
"""

import asyncio
import ipaddress
import json
import os
import re
import shlex
from collections.abc import Awaitable, Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from appliance.channel import messages
from appliance.configuration.settings import LivenessSection
from appliance.master.endpoints.delivery import NodeCall
from appliance.master.graph.registry import Incarnation, Kind
from appliance.master.graph.revocation import CALLS
from appliance.policy.model import text_for_caller
from roswire.xmlrpc import FaultReceived, Value
from tests.support.control_parts import ControlParts, Ended, Record, Seen, Told
from tests.support.conversation_calls import OWN, PORTS, QUESTIONS, WrittenCall, call_of, is_call

_RECORD = re.compile(r"\[[0-9a-f]{20}\]")
_REGISTER = {Kind.PUBLICATION: "registerPublisher", Kind.SUBSCRIPTION: "registerSubscriber"}


class Conversation:
    def __init__(self, parts: ControlParts, policies: dict[str, str], *, only_answers: bool = False) -> None:
        self.parts = parts
        self._only_answers = only_answers
        self._policies = policies
        self._names: dict[str, str] = {}  # of incarnations, by their keys
        self._begun: dict[str, asyncio.Task[list[str]]] = {}  # calls without an answer, by their lines
        self._held = False  # changes wait for the ROS master

    async def say(self, line: str) -> list[str]:
        self.parts.seen.clear()
        self.parts.records.clear()
        call = line.removeprefix("begin ")
        if call != line:
            self._begun[call] = asyncio.create_task(self._call_by(call))
            answers = []
        else:
            answers = await (self._call_by(line) if is_call(line) else self._event(line))
        await self._settle()
        answers = [_RECORD.sub("[id]", answer) for answer in (*answers, *self._finished())]
        if self._only_answers:
            return answers
        shown = [self._shown(seen) for seen in self.parts.seen]
        refused = [f"record {record}" for record in self.parts.records.refused]
        withheld = [f"withhold {one.resource}" for one in self.parts.records.denied]
        return [*answers, *refused, *filter(None, shown), *withheld]

    async def _settle(self) -> None:
        for _ in range(50):
            await asyncio.sleep(0)
        if not self._held and all(task.done() for task in self._begun.values()):
            await self.parts.settle()
        self._name_nodes()

    def _name_nodes(self) -> None:
        for node in self.parts.registry.all():
            life = node.api.port - PORTS
            self._names.setdefault(node.key, f"{node.name}:{life}" if life in range(2, 10) else node.name)

    def _finished(self) -> list[str]:
        finished = [line for line, task in self._begun.items() if task.done()]
        return [
            f"answered {line}: {answer}"
            for line in finished
            for answer in self._begun.pop(line).result() or ["done"]
        ]

    async def _call_by(self, line: str) -> list[str]:
        call = call_of(line)
        answer = await self._ask(call)
        if not call.parts:
            return self._answered(call.method, answer, raw=call.raw or self._only_answers)
        assert isinstance(answer, list)
        return [
            f"{number}. {shown}"
            for number, (part, one) in enumerate(zip(call.parts, answer, strict=True), 1)
            for shown in self._answered(part, one[0] if isinstance(one, list) else one) or ["done"]
        ]

    async def _ask(self, call: WrittenCall) -> Value:
        target = None if call.node is None else self._node(call.node)
        try:
            return await self.parts.ask(
                call.method,
                *call.params,
                host="127.0.0.1" if call.host == OWN else call.host,
                own=call.host == OWN,
                target=target,
            )
        except FaultReceived as fault:
            return {"faultString": fault.text}
        finally:
            self._name_nodes()

    def _answered(self, method: str, answer: Any, *, raw: bool = False) -> list[str]:
        if isinstance(answer, dict):
            return [f"fault: {answer['faultString']}"]
        if raw and not (answer and isinstance(answer[0], int)):
            return [f"{number}. {one}" for number, part in enumerate(answer, 1) for one in self._part(part)]
        code, text, value = answer
        if code == 0:
            return self._denied(text)
        if code == -1 and (raw or method not in QUESTIONS):
            return [f"error: {text}: {json.dumps(value)}"]
        if raw or method in QUESTIONS:
            return [
                self._with_names(f"answer: {text}: {json.dumps(value)}") if code == 1 else f"answer: {text}"
            ]
        return []

    def _part(self, part: Any) -> list[str]:
        return self._answered("", part[0] if isinstance(part, list) else part, raw=True)

    def _denied(self, text: str) -> list[str]:
        denied = self.parts.records.denied
        for place, one in enumerate(denied):
            told = text_for_caller(one.decision, self.parts.current.tell)
            if text == f"{told} [{one.record}]":
                del denied[place]
                about = "".join(f" {name} {value}" for name, value in one.about.items())
                longer = (
                    [f"recorded: {one.decision.reason}"]
                    if one.decision.told and not one.decision.rule
                    else []
                )
                return [f"deny {one.category} {one.resource}{about}: {text}", *longer]
        return [f"refused: {text}"]

    async def _event(self, line: str) -> list[str]:
        parts = self.parts
        match shlex.split(line):
            case ["state"]:
                return self._state()
            case ["a", "relay", "starts", "anew"]:
                parts.start_relay()
                parts.subscribers.remind_all()
            case ["policy", *names]:
                for name in names:
                    parts.reload(self._policies[name.rstrip(",")])
            case ["host", host, "is", "expelled"]:
                parts.enforcement.expel(ipaddress.ip_address(host), "the host was expelled")
            case ["registering", "calls", "wait"]:
                self._held = True
                parts.go.clear()
            case ["registering", "calls", "go", "on"]:
                self._held = False
                parts.go.set()
            case ["a", "round"]:
                self._held = False
                await parts.round()
            case ["nodes", "may", "be", "silent", "for", seconds, "s"]:
                parts.liveness.settings = LivenessSection(silent=float(seconds))
            case ["ROSMaster", *happening]:
                await self._master_event(happening)
            case [name, *happening]:
                await self._node_event(self._node(name), happening)
        return []

    async def _master_event(self, happening: list[str]) -> None:
        hidden = self.parts.hidden
        match happening:
            case ["starts", "anew"]:
                self._held = False
                hidden.restart()
                await self.parts.round()
            case ["stops"]:
                self._held = True
                self.parts.rosmaster.shut()
            case ["is", "slow"]:
                self._held = True
                hidden.go.clear()
            case ["answers"]:
                self._held = False
                hidden.go.set()
            case ["has", name, kind, resource, "of", owner]:
                uri = self.parts.faces.inner_uri(self._node(owner))
                await hidden.call(_REGISTER[Kind(kind)], name, resource, "type", uri)
            case _:
                raise ValueError(f"unknown action: ROSMaster {' '.join(happening)!r}")

    async def _node_event(self, node: Incarnation, happening: list[str]) -> None:
        match happening:
            case ["misses", "the", "list", "of", topic]:
                missed = NodeCall("publisherUpdate", (topic, []))
                self.parts.watchlist.could_not_tell(node, missed, "it does not answer")
            case ["loses", "its", "connection", "for", topic]:
                self.parts.watchlist.cut_off(node, topic)
            case ["is", "forgotten"]:
                self.parts.graph.forgotten(node)
            case ["dies"] | ["is", "silent"] | ["answers"]:
                nodes = self.parts.nodes
                for names, word in ((nodes.gone, "dies"), (nodes.silent, "silent")):
                    (names.add if happening[-1] == word else names.discard)(node.name)
                await self.parts.look(node)
            case _:
                raise ValueError(f"unknown action: {' '.join(happening)!r}")

    def _state(self) -> list[str]:
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
        node = self._at_inner_uri(self.parts.hidden.nodes[name])
        return name if node is None else self._names[node.key]

    def _at_inner_uri(self, uri: str) -> Incarnation | None:
        return self.parts.registry.by_key(uri.rstrip("/").rpartition("/")[2])

    def _node(self, name: str) -> Incarnation:
        keys = [key for key, known in self._names.items() if known == name]
        node = self.parts.registry.by_key(keys[0])
        assert node is not None
        return node

    # --- as text ---

    def _stated(self, message: messages.Message) -> str:
        match message:
            case messages.FactWithdrawn((word, key, *rest)):
                return _fact(word, self._names[key], rest, stated=False)
        if isinstance(message, messages.RelayFact):
            word, key, *rest = messages.identity(message)
            return _fact(word, self._names[key], rest, stated=True)
        return ""

    def _shown(self, seen: Seen) -> str:
        match seen:
            case Told(node, call):
                values = " ".join(self._value(parameter) for parameter in call.parameters)
                return f"tell {self._names[node.key]} {call.method} {values}"
            case Ended(what, node):
                return f"{what} {self._names[node.key]}"
            case Record(event, caller_id, category, resource):
                return f"record {event}: {caller_id} {category} {resource}"
            case messages.Message():
                return self._stated(seen)
        method, (caller, about, *_detail, uri) = seen
        registered = self._at_inner_uri(str(uri))
        name = caller if registered is None else self._names[registered.key]
        kind = next(kind for kind, calls in CALLS.items() if method in calls)
        ended = " no more" if method == CALLS[kind][1] else ""
        return f"ROSMaster: {name!s} has {kind} {about!s}{ended}"

    def _value(self, value: Value) -> str:
        if isinstance(value, list):
            return f"[{', '.join(self._value(one) for one in value)}]"
        return self._with_names(str(value))

    def _with_names(self, text: str) -> str:
        for one in self.parts.registry.all():
            name = self._names[one.key]
            for uri in (one.outer_uri(one.told), f"rosrpc://{one.told}:{one.relay_port}"):
                text = text.replace(uri, name)
            text = text.replace(one.api_text, f"{name} itself")
        return text


def _fact(word: str, node: str, about: list[str], *, stated: bool) -> str:
    match about:
        case [resource, host, name]:
            kind = {"grant": "topic", "client": "service"}[word]
            return f"{'grant' if stated else 'revoke'} {name} of {host} {kind} {resource} of {node}"
        case [resource]:
            return f"{'place' if stated else 'withdraw'} {node} {word} {resource}"
    return "" if stated else f"withdraw {node}"


def _listed(registrations: Iterable[tuple[Kind, str]]) -> str:
    return ", ".join(f"{kind} {resource}" for kind, resource in registrations) or "nothing"


class ConversationFile(NamedTuple):
    only_answers: bool
    policies: dict[str, str]
    conversations: dict[str, str]


def conversations_of(text: str) -> ConversationFile:
    head, *conversations = f"\n{text}".split("\n# ")
    policies: dict[str, str] = {}
    for part in head.split("\npolicy ")[1:]:
        name, _, rules = part.partition("\n")
        name, _, base = name.partition(" like ")
        policies[name] = policies.get(base, "") + re.sub(r"(?m)^    ", "", f"{rules}\n")
    titled = dict(conversation.strip().split("\n", 1) for conversation in conversations)
    return ConversationFile(text.startswith("only answers\n"), policies, titled)


async def taken_place(file: ConversationFile, title: str) -> str:
    conversation = Conversation(await ControlParts.begun(), file.policies, only_answers=file.only_answers)
    return await played(file.conversations[title], conversation.say)


async def played(written: str, say: Callable[[str], Awaitable[list[str]]]) -> str:
    lines: list[str] = []
    for line in written.splitlines():
        if line and not line.startswith(" "):
            action = line.removeprefix("given ")
            effects = await say(action)
            lines += [line, *(f"    {effect}" for effect in effects if action == line)]
    return "\n".join(lines)


def compare(file: Path, title: str, written: str, took_place: str) -> None:
    """Compare the text of a conversation with what took place; with `TRANSCRIPTS=write`, write that to the file."""
    if took_place != written and os.environ.get("TRANSCRIPTS") == "write":
        text = file.read_text(encoding="utf-8")
        text = text.replace(f"# {title}\n{written}\n", f"# {title}\n{took_place}\n")
        file.write_text(text, encoding="utf-8")
    assert took_place.splitlines() == written.splitlines()
