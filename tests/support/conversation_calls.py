import json
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

OWN = "own"  # in place of a host: the appliance's own node
# The parameters of calls after the caller's name: R a resource, V a text, J a value, P protocols, A the node's API,
# S the API of its service.
_SHAPES = {
    "registerPublisher": "RVA",
    "registerSubscriber": "RVA",
    "registerService": "RSA",
    "unregisterPublisher": "RA",
    "unregisterSubscriber": "RA",
    "unregisterService": "RS",
    "subscribeParam": "AR",
    "unsubscribeParam": "AR",
    "setParam": "RJ",
    "publisherUpdate": "RJ",
    "paramUpdate": "RJ",
    "requestTopic": "RP",
}
# Calls whose answer is not only that they were carried out.
QUESTIONS = {
    "getParam", "getParamNames", "getPid", "getPublishedTopics", "getSystemState", "getTopicTypes", "getUri",
    "hasParam", "lookupNode", "lookupService", "searchParam",
}  # fmt: skip
PORTS = 40_000
_RAW = re.compile(r"(\S+) calls (\S+) (\[.*\])(?: of (\S+))?")


@dataclass(frozen=True)
class WrittenCall:
    host: str
    method: str
    params: Sequence[Any]
    node: str | None
    parts: Sequence[str] = ()
    raw: bool = False


def is_call(line: str) -> bool:
    return line[0].isdigit() or line.startswith(f"{OWN} ")


def call_of(line: str) -> WrittenCall:
    raw = _RAW.fullmatch(line)
    if raw is not None:
        host, method, text, node = raw.groups()
        return WrittenCall(host, method, json.loads(text), node, raw=True)
    host, name, method, *rest = shlex.split(line)
    if method != "multicall":
        node = rest[-1] if rest[-2:-1] == ["of"] else None
        return WrittenCall(host, method, _parameters(host, name, method, rest[: -2 if node else None]), node)
    calls = [shlex.split(part) for part in line.partition(" multicall ")[2].split(" | ")]
    parts = [{"methodName": one, "params": _parameters(host, name, one, of)} for one, *of in calls]
    return WrittenCall(host, "system.multicall", [parts], None, [one for one, *_ in calls])


def _parameters(host: str, name: str, method: str, rest: list[str]) -> list[Any]:
    name, _, life = name.partition(":")
    given, parameters = iter(rest), list[Any]([name])
    for shape in _SHAPES.get(method, "R" * len(rest)):
        match shape:
            case "A":
                parameters.append(f"http://{host}:{PORTS + int(life or 1)}/")
            case "S":
                parameters.append(f"rosrpc://{host}:{next(given)}")
            case "J":
                parameters.append(json.loads(next(given)))
            case "P":
                parameters.append(json.loads(next(given, '[["TCPROS"]]')))
            case _:
                parameters.append(next(given))
    return parameters
