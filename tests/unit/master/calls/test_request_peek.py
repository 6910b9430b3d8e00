import ipaddress
from typing import Any

import pytest

from appliance.master.calls.request_peek import asked_for
from appliance.policy.model import Category
from appliance.rpc.server import Peer
from roswire.xmlrpc import Value, build_call

PEER = Peer(ipaddress.ip_address("10.0.0.9"), "10.0.0.9", "10.0.0.1")


PARTS: list[Value] = [{"methodName": "setParam", "params": []}, {"methodName": "shutdown", "params": []}]


@pytest.mark.parametrize(
    ("method", "params", "record"),
    [
        ("registerPublisher", ("/evil", "/cmd_vel", "std_msgs/String", "http://10.0.0.9:1/"),
         (Category.PUBLISH, "/cmd_vel", "/evil", {"call": "registerPublisher"})),
        ("setParam", ("/a/b", "speed", 1),
         (Category.COMMAND, "setParam", "/a/b", {"call": "setParam", "key": "/a/speed"})),
        ("system.multicall", (PARTS,),
         (Category.COMMAND, "system.multicall", None, {"call": "system.multicall", "parts": "setParam, shutdown"})),
        ("x" * 1000, (), (Category.COMMAND, "x" * 200, None, {"call": "unknown"})),
        ("registerPublisher", ("/evil", 7),
         (Category.COMMAND, "registerPublisher", "/evil", {"call": "registerPublisher"})),
    ],
    ids=["registration", "command", "multicall", "unknown method", "wrong arguments"],
)  # fmt: skip
def test_a_record_names_what_was_asked_for(
    method: str, params: tuple[Value, ...], record: tuple[Any, ...]
) -> None:
    assert tuple(asked_for(PEER, build_call(method, params))) == record


@pytest.mark.parametrize("cut", [120, 200, 4096])
def test_a_body_that_is_cut_names_its_method(cut: int) -> None:
    body = build_call("setParam", ("/evil", "/k", "v" * 100_000))[:cut]
    assert asked_for(PEER, body)[:2] == (Category.COMMAND, "setParam")


@pytest.mark.parametrize("body", [b"", b"\0\xff", b"<methodName>", b"<methodName><!-- --></methodName>"])
def test_a_body_without_a_method(body: bytes) -> None:
    assert asked_for(PEER, body) == (Category.COMMAND, "", None, {"call": "unknown"})
