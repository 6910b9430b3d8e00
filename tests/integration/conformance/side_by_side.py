"""Make the same Master API call to a plain ROS master and to RVMaster, and make their answers comparable.

Only URIs and ids may differ by design: each URI becomes the name of its node. `Api` and `ServiceApi` are placeholders
for URIs of fake nodes, of which each master has its own.
"""

import itertools
import re
import xmlrpc.client
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tests.integration.conformance.fake_nodes import FakeNodes

_HTTP_URI = re.compile(r"http://127\.0\.0\.1:\d+/[\w-]*")
_SERVICE_URI = re.compile(r"rosrpc://[\w.]+:\d+")
_UNDO = {
    "registerPublisher": ("unregisterPublisher", (0, 1, 3)),
    "registerSubscriber": ("unregisterSubscriber", (0, 1, 3)),
    "registerService": ("unregisterService", (0, 1, 2)),
    "subscribeParam": ("unsubscribeParam", (0, 1, 2)),
}
TESTER = "/conformance"
_EPOCHS = itertools.count()


@dataclass(frozen=True, slots=True)
class Api:
    node: str
    life: int = 1


@dataclass(frozen=True, slots=True)
class ServiceApi:
    port: int


@dataclass(frozen=True, slots=True)
class Fault:
    code: int
    text: str


@dataclass(frozen=True, slots=True)
class Answers:
    plain: Any
    appliance: Any


class MasterSide:
    def __init__(self, uri: str, nodes: FakeNodes) -> None:
        self.uri = uri.rstrip("/")
        self.nodes = nodes
        # Used in the URIs, so that a node replaced in one test is new in the next.
        self.epoch = next(_EPOCHS)
        self._server = xmlrpc.client.ServerProxy(uri, allow_none=True)
        rosout = self.call("lookupNode", [TESTER, "/rosout"])[2]
        self._names: dict[str, str] = {rosout: "<rosout>"}

    def call(self, method: str, params: Sequence[Any]) -> Any:
        try:
            return getattr(self._server, method)(*self.given(params))
        except xmlrpc.client.Fault as fault:
            return Fault(fault.faultCode, fault.faultString)

    def given(self, value: Any) -> Any:
        match value:
            case Api():
                return self.nodes.uri(f"{value.node}-{value.life}-{self.epoch}")
            case ServiceApi():
                return f"rosrpc://127.0.0.1:{value.port}"
            case dict():
                return {key: self.given(one) for key, one in value.items()}
            case list() | tuple():
                return [self.given(one) for one in value]
        return value

    def named(self, value: Any) -> Any:
        match value:
            case str():
                text = _HTTP_URI.sub(lambda found: self._name(found.group()), value)
                return _SERVICE_URI.sub("<service>", text)
            case dict():
                return {key: self.named(one) for key, one in value.items()}
            case list() | tuple():
                return [self.named(one) for one in value]
        return value

    def _name(self, uri: str) -> str:
        if uri.rstrip("/") == self.uri:
            return "<master>"
        if uri.startswith(self.nodes.base):
            return f"<{uri.removeprefix(self.nodes.base).split('-')[0]}>"
        if uri not in self._names:
            try:
                with xmlrpc.client.ServerProxy(uri) as node:
                    answer: Any = node.getName(TESTER)
            except ConnectionRefusedError:  # a list from before its node was replaced
                return "<gone>"
            self._names[uri] = f"<{answer[2].rpartition('/')[2]}>"
        return self._names[uri]

    def close(self) -> None:
        self._server("close")()


class BothMasters:
    def __init__(self, plain: MasterSide, appliance: MasterSide) -> None:
        self.plain, self.appliance = plain, appliance
        self._registered: dict[tuple[str, tuple[Any, ...]], None] = {}
        tree = self.appliance.call("getParam", [TESTER, "/"])[2]
        self._first_tree = dict(tree)
        self.reset()

    def call(self, method: str, *params: Any) -> Answers:
        plain, appliance = self.plain.call(method, params), self.appliance.call(method, params)
        if method in _UNDO and isinstance(plain, list) and plain[0] == 1:
            undo, positions = _UNDO[method]
            self._registered[undo, tuple(params[position] for position in positions)] = None
        return Answers(self.plain.named(plain), self.appliance.named(appliance))

    def reset(self) -> None:
        for method, params in reversed(self._registered):
            self.plain.call(method, params)
            self.appliance.call(method, params)
        self._registered.clear()
        for side in (self.plain, self.appliance):
            side.call("setParam", [TESTER, "/", self._first_tree])
            side.nodes.forget()
            side.epoch = next(_EPOCHS)


def differences(answers: Answers) -> list[str]:
    """Return the differences that a client library would notice: code, type and content of the value, message.

    The message about an invalid parameter may differ, but must name the same parameter. The reason why an
    unregistration ends nothing may differ, because a plain master counts a node whose service moved to another node.
    For some errors, a plain master returns 0 for every call, whereas the appliance returns an empty value of the
    call's type.
    """
    plain, appliance = answers.plain, answers.appliance
    if isinstance(plain, Fault) or isinstance(appliance, Fault):
        return [] if type(plain) is type(appliance) else [f"fault against answer: {plain} / {appliance}"]
    if len(plain) != 3 or len(appliance) != 3:
        return [f"not [code, message, value]: {plain} / {appliance}"]
    found = []
    if not same(plain[0], appliance[0]):
        found.append(f"code {plain[0]!r} / {appliance[0]!r}")
    if _told(plain[1]) != _told(appliance[1]):
        found.append(f"message {plain[1]!r} / {appliance[1]!r}")
    empty = plain[0] == -1 and same(plain[2], 0) and appliance[2] in ("", [])
    if not same(plain[2], appliance[2]) and not empty:
        found.append(f"value {plain[2]!r} / {appliance[2]!r}")
    return found


def same(one: Any, other: Any) -> bool:
    """Return whether values are equal with the same types: `1` differs from `True` and `1.0`, `nan` equals `nan`."""
    if type(one) is not type(other):
        return False
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other) or (one != one and other != other)  # noqa: PLR0124 - nan differs from itself


def _told(message: str) -> str:
    if re.match(
        r"\[[^]]+\] is (not a registered node$|not a (known )?provider of|no longer the current)", message
    ):
        return "nothing ended"
    match = re.match(r"ERROR: parameter \[\w+\]", message)
    return match.group() if match else message
