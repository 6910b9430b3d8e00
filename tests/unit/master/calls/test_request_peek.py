"""What is told of a request that is refused by the beginning of its body."""

import ipaddress

import pytest

from appliance.master.calls.request_peek import asked_for
from appliance.policy.model import Category
from appliance.rpc.server import Peer
from roswire.xmlrpc import Value, build_call

PEER = Peer(ipaddress.ip_address("10.0.0.9"), "10.0.0.9", "10.0.0.1")


def asked(method: str, *params: Value) -> tuple[Category, str, str | None, dict[str, str]]:
    """What is told of a whole call."""
    return tuple(asked_for(PEER, build_call(method, params)))  # type: ignore[return-value]  # the fields


def test_a_registration_names_its_topic() -> None:
    """The record of a stranger's registration has what a decision of it has: category, topic, the claimed name."""
    assert asked("registerPublisher", "/evil", "/cmd_vel", "std_msgs/String", "http://10.0.0.9:1/") == (
        Category.PUBLISH, "/cmd_vel", "/evil", {"call": "registerPublisher"},
    )  # fmt: skip


def test_a_command_names_its_key() -> None:
    """A command is its name, with the key it is about, resolved as the policy would see it."""
    assert asked("setParam", "/a/b", "speed", 1) == (
        Category.COMMAND, "setParam", "/a/b", {"call": "setParam", "key": "/a/speed"},
    )  # fmt: skip


def test_a_multicall_names_its_parts() -> None:
    """A multicall has the methods of its first parts."""
    parts: list[Value] = [{"methodName": "setParam", "params": []}, {"methodName": "shutdown", "params": []}]
    assert asked("system.multicall", parts) == (
        Category.COMMAND, "system.multicall", None, {"call": "system.multicall", "parts": "setParam, shutdown"},
    )  # fmt: skip


def test_what_is_no_call_of_ours() -> None:
    """A method that is not served is named, and makes no kind of its own."""
    category, resource, _caller, about = asked("x" * 1000)
    assert (category, resource, about) == (Category.COMMAND, "x" * 200, {"call": "unknown"})


def test_wrong_arguments_still_name_the_call() -> None:
    """A known call with arguments that it does not take is named, with what its caller claims."""
    assert asked("registerPublisher", "/evil", 7) == (
        Category.COMMAND, "registerPublisher", "/evil", {"call": "registerPublisher"},
    )  # fmt: skip


@pytest.mark.parametrize("cut", [120, 200, 4096])
def test_a_body_that_is_cut_names_its_method(cut: int) -> None:
    """Of a large body the beginning has the method."""
    body = build_call("setParam", ("/evil", "/k", "v" * 100_000))[:cut]
    assert asked_for(PEER, body)[:2] == (Category.COMMAND, "setParam")


@pytest.mark.parametrize("body", [b"", b"\0\xff", b"<methodName>", b"<methodName><!-- --></methodName>"])
def test_what_has_no_method(body: bytes) -> None:
    """Rubbish has no resource, and is no error."""
    assert asked_for(PEER, body) == (Category.COMMAND, "", None, {"call": "unknown"})
