"""Attacks on the graph by calls from another host: identity, names, parameters, services, addresses, endpoints.

After each attack the robot's talker and its operator's listener still run (the fixture checks this). The caller gets
the reason in the form of its library, and the audit log has the denial with its rule.
"""

import contextlib
import json
import re
import socket
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from appliance.network.scan import scan
from roswire.tcpros import HeaderParser
from tests.support.field import Field, Impostor, answering, response
from tests.support.processes import LIMIT

POLICY = """\
[Groups]
own   = 10.77.0.10 10.77.0.20
rogue = 10.77.0.66
all   = own rogue

[Nodes]
default    = all
/guarded_* = own

[Publishers]
default    = own
/shared/** = all
/rosout    = all

[Subscribers]
default    = own
/shared/** = all

[Services]
default    = own
/shared/** = all

[Clients]
default    = own
/shared/** = all

[Parameters]
read default     = all
read /secret/**  = own
write default    = own
write /shared/** = all
write /shared/fixed = own
write /leaf      = all

[Commands]
default  = all
shutdown = own
"""
API = Field.api
ROGUE = r"10\.77\.0\.66"
VOICE_TOLD = "/voice is held by a node of another host; 10.77.0.66 cannot speak for it"
VOICE_HELD = "/voice is held by 10.77.0.10; 10.77.0.66 cannot speak for it"
TCPROS = [["TCPROS"]]
LOOPBACK = "0100007F"  # as /proc/net/tcp writes 127.0.0.1


@pytest.fixture(scope="module", autouse=True)
def graph(battlefield: Field) -> Iterator[None]:
    """Add a secret, a service and a topic for every host to the graph."""
    own = battlefield.ros
    own.run("rosparam", "set", "/secret/key", "4711")
    own.run("rosparam", "set", "/open_key", "1")
    own.service_server("rospy", "/negate", name="negator")
    own.service_server("roscpp", "/shared/negate", name="shared_negator")
    own.talker("roscpp", "/shared/talk", name="shared_voice")
    yield
    negate = own.service_client("rospy", "/negate", name="last_client")
    negate.send("true")
    negate.wait_for(event="answered", success=False)
    assert own.run("rosparam", "get", "/secret/key").stdout.strip() == "4711"


@pytest.fixture(autouse=True)
def no_hidden_port_is_revealed(field: Field) -> Iterator[None]:
    """Assert that the answers to the rogue contain no hidden port.

    Ports of `rosmaster`, of master-side endpoints and of real nodes are hidden.
    """
    since = len(field.answers)
    yield
    hidden = {port for address, port in field.middle.run(_listening) if address == LOOPBACK}
    real = {port for _, port in field.robot.run(_listening)} | {port for _, port in field.ocu.run(_listening)}
    assert hidden and real
    for method, answer in field.answers[since:]:
        text = answer.decode("latin-1") if isinstance(answer, bytes) else str(answer)
        told = {
            int(port) for port in re.findall(rf"(?<!{ROGUE}):(\d+)\b", text)
        }  # the rogue knows its own URIs
        assert not told & (hidden | real), f"{method} revealed {told & (hidden | real)}: {text[:500]}"
        assert not re.search(r"\b[0-9a-f]{32}\b", text), f"{method} revealed a key: {text[:500]}"


def outer(field: Field, node: str) -> str:
    """Return the address of a node that the rogue gets."""
    code, _text, uri = field.rogue("lookupNode", "/looker", node)
    assert code == 1
    return str(uri)


# --- identity of the caller ---


@pytest.mark.parametrize(
    ("method", "parameters", "category"),
    [
        ("unregisterPublisher", ("/shared/talk", API), "publish"),
        ("unregisterSubscriber", ("/shared/talk", API), "subscribe"),
        ("unregisterService", ("/shared/negate", "rosrpc://10.77.0.10:1"), "offer"),
        ("unsubscribeParam", (API, "/shared/x"), "command"),
        ("subscribeParam", (API, "/shared/x"), "command"),
        ("setParam", ("/shared/x", 1), "command"),
        ("deleteParam", ("/shared/x",), "command"),
        ("getParam", ("/shared/x",), "command"),
        ("hasParam", ("/shared/x",), "command"),
        ("searchParam", ("x",), "command"),
        ("getParamNames", (), "command"),
        ("getSystemState", (), "command"),
        ("getPublishedTopics", ("",), "command"),
        ("getTopicTypes", (), "command"),
        ("lookupNode", ("/voice",), "command"),
        ("lookupService", ("/shared/negate",), "call"),
        ("getUri", (), "command"),
        ("getPid", (), "command"),
    ],
)
def test_call_in_the_name_of_another_hosts_node(
    field: Field, method: str, parameters: tuple[Any, ...], category: str
) -> None:
    """Deny every call of the Master API in the name of a node on another host."""
    answer = field.rogue(method, "/voice", *parameters)
    allowed_but_held = {"subscribeParam": "is held by", "unsubscribeParam": "is held by"}
    told = allowed_but_held.get(method, VOICE_TOLD)
    record = field.denied(
        answer, told, in_record="is held by 10.77.0.10", caller_id="/voice", category=category
    )
    assert record["detail"]["call"] == method


@pytest.mark.parametrize("method", ["registerPublisher", "registerSubscriber"])
def test_takeover_of_a_running_node(field: Field, method: str) -> None:
    """A node that runs on another host keeps its name, even if the policy grants it to both."""
    answer = field.rogue(method, "/voice", "/shared/talk", "std_msgs/String", API)
    field.denied(answer, "/voice is held by a running node of another host", in_record="node on 10.77.0.10")
    assert answer[2] == []


def test_takeover_by_registering_a_service(field: Field) -> None:
    """Registering a service also cannot take over the name of a running node."""
    answer = field.rogue("registerService", "/voice", "/shared/s", "rosrpc://10.77.0.66:9", API)
    held = "/voice is held by a running node"
    field.denied(answer, f"{held} of another host", in_record=f"{held} on 10.77.0.10", category="offer")


def test_name_that_the_policy_reserves(field: Field) -> None:
    """Deny every use of a free name that `[Nodes]` grants to other hosts."""
    answer = field.rogue("registerPublisher", "/guarded_1", "/shared/talk", "std_msgs/String", API)
    field.denied(answer, "/guarded_1", rule="[Nodes] /guarded_*", category="publish")


def test_name_of_the_appliances_own_node(field: Field) -> None:
    """Deny `/rosout`, the name of the appliance's own node."""
    answer = field.rogue("registerPublisher", "/rosout", "/shared/talk", "std_msgs/String", API)
    field.denied(answer, "the name /rosout belongs to the appliance")


def test_rosout_receives_every_nodes_log(field: Field) -> None:
    """The rosout aggregator receives every node's log, though the policy names neither it nor this machine."""
    for name in ("voice", "ear"):
        field.recorded(f"is connected to /rosout of /{name}", event="connection opened", caller_id="/rosout")


@pytest.mark.parametrize("method", ["getPid", "getName", "getUri", "getMasterUri", "getBusInfo", "getBusStats",
                                    "getSubscriptions", "getPublications"])  # fmt: skip
def test_node_api_call_in_the_name_of_another_hosts_node(field: Field, method: str) -> None:
    """Deny calls of a node's endpoint in the name of a node on another host."""
    answer = field.rogue(method, "/ear", uri=outer(field, "/shared_voice"))
    record = field.denied(answer, "/ear is held by", in_record="/ear is held by 10.77.0.20", caller_id="/ear")
    assert record["detail"]["node"] == "/shared_voice"


def test_topic_request_in_another_nodes_name(field: Field) -> None:
    """The subscriber's name in `requestTopic` is bound to its host."""
    uri = outer(field, "/shared_voice")
    answer = field.rogue("requestTopic", "/ear", "/shared/talk", TCPROS, uri=uri)
    field.denied(answer, "/ear is held by", in_record="/ear is held by 10.77.0.20")


def test_late_call_of_a_replaced_node(field: Field) -> None:
    """A replaced node on the same host can neither unregister its successor under the same name nor return."""
    with (
        Impostor(field.attacker, answering([1, "", 0])) as old,
        Impostor(field.attacker, answering([1, "", 7])) as new,
    ):
        for one in (old, new):
            assert (
                field.rogue("registerPublisher", "/twin", "/shared/twin", "std_msgs/String", one.uri)[0] == 1
            )
        assert old.called.wait(LIMIT)  # `rosmaster` orders its shutdown, through the appliance
        assert b"shutdown" in old.requests[-1] or old.called.is_set()
        for method in ("unregisterPublisher", "registerPublisher"):
            parameters = (
                ("/shared/twin2", "std_msgs/String") if method == "registerPublisher" else ("/shared/twin",)
            )
            answer = field.rogue(method, "/twin", *parameters, old.uri)
            field.denied(answer, "this call is late: the node /twin", caller_id="/twin")
        state = field.call(field.robot, "getSystemState", "/looker")[2]
        assert ["/shared/twin", ["/twin"]] in state[0]


def test_unregistering_with_the_real_uri_of_the_victim(field: Field) -> None:
    """The real URI of a victim does not help an attacker, because the appliance identifies a caller by its address."""
    uri = field.talker.seen(event="ready")[0]["uri"]
    answer = field.rogue("unregisterPublisher", "/another", "/shared/talk", uri)
    assert answer[:1] == [1]  # "not a registered node" of `rosmaster`
    assert "not a registered node" in answer[1]
    answer = field.rogue("unregisterPublisher", "/voice", "/shared/talk2", uri)
    field.denied(answer, VOICE_TOLD, in_record=VOICE_HELD)


# --- multicall ---


def part(method: str, *params: Any) -> dict[str, Any]:
    """Return one part of a multicall."""
    return {"methodName": method, "params": list(params)}


def test_multicall_is_decided_part_by_part(field: Field) -> None:
    """Each part of a multicall is decided separately: allowed parts do not let denied parts pass."""
    answers = field.rogue(
        "system.multicall",
        [
            part("getPid", "/mixer"),
            part("setParam", "/mixer", "/forbidden", 1),
            part("unregisterPublisher", "/voice", "/shared/talk3", API),
            part("setParam", "/mixer", "/shared/mixed", 2),
        ],
    )
    assert [one[0][0] for one in answers] == [1, 0, 0, 1]
    field.denied(answers[1][0], "/forbidden", rule="[Parameters] write default", caller_id="/mixer")
    field.denied(answers[2][0], VOICE_TOLD, in_record=VOICE_HELD, caller_id="/voice")
    assert field.call(field.robot, "getParam", "/looker", "/shared/mixed")[2] == 2
    assert field.call(field.robot, "hasParam", "/looker", "/forbidden")[2] is False


def test_nested_multicall(field: Field) -> None:
    """A nested multicall is rejected and recorded, and its parts are not carried out."""
    inner = part("system.multicall", [part("setParam", "/mixer", "/shared/nested", 1)])
    [fault] = field.rogue("system.multicall", [inner])
    assert "multicall inside a multicall" in fault["faultString"]
    field.recorded(
        event="malformed", host="10.77.0.66", reason="a multicall inside a multicall is not served"
    )
    assert field.call(field.robot, "hasParam", "/looker", "/shared/nested")[2] is False


@pytest.mark.parametrize(
    "parts",
    [
        "text",
        [7],
        [{"methodName": "getPid"}],
        [part("getPid", "/x") | {"extra": 1}],
        [{"methodName": 7, "params": []}],
    ],
    ids=repr,
)
def test_malformed_multicall(field: Field, parts: Any) -> None:
    """A multicall without a list of calls is an error of the caller."""
    answer = field.rogue("system.multicall", parts)
    assert "multicall" in str(answer)
    field.recorded(event="malformed", host="10.77.0.66", resource="system.multicall")


def test_multicall_on_a_nodes_face(field: Field) -> None:
    """Neither a node nor its endpoint serves multicalls."""
    answer = field.rogue("system.multicall", [part("getPid", "/x")], uri=outer(field, "/shared_voice"))
    field.denied(answer, "'system.multicall' is not a call that is served here")


# --- names ---


@pytest.mark.parametrize(
    ("spelling", "reason"),
    [
        ("//chatter", "/chatter"),
        ("/chatter/", "/chatter"),
        ("//chatter///", "/chatter"),
        ("chatter", "/chatter"),
    ],
)
def test_other_spellings_of_a_topic(field: Field, spelling: str, reason: str) -> None:
    """Every spelling that `rosmaster` treats as `/chatter` is decided as `/chatter`."""
    answer = field.rogue("registerPublisher", "/spell" + spelling.replace("/", "_"), spelling,
                         "std_msgs/String", API)  # fmt: skip
    field.denied(answer, reason, rule="[Publishers] default", resource="/chatter")


@pytest.mark.parametrize(
    "name",
    ["/chatter\u200b", "/ch\u0430tter", "/chatter\u0301", "/chatter ", " /chatter", "/chatter%00", "/../chatter",
     "/./chatter", "/shared/..", "~~x", "/a//~b", "", "/", "/-chatter", "/chatter?", "/shared/*", "\u2215chatter",
     "/" + "a" * 2000, "/a" * 600],
    ids=lambda name: ascii(name)[:24],
)  # fmt: skip
@pytest.mark.parametrize("method", ["registerPublisher", "registerSubscriber"])
def test_names_outside_the_grammar(field: Field, method: str, name: str) -> None:
    """Reject names that look like other names, or that `rosmaster` would split."""
    answer = field.rogue(method, "/namer", name, "std_msgs/String", API)
    assert (answer[0], answer[2]) == (-1, []), answer
    assert "parameter [topic]" in answer[1]
    assert len(answer[1]) < 400
    topics = {topic for rows in field.call(field.robot, "getSystemState", "/looker")[2] for topic, _ in rows}
    assert all(re.fullmatch(r"(/\w+)+", topic, re.ASCII) for topic in topics)


@pytest.mark.parametrize(
    "caller_id",
    [
        "voice",
        "~voice",
        "/v\u043eice",
        "/voice ",
        "/VOICE\u00a0",
        "",
        "/",
        "/" + "x" * 5000,
    ],
    ids=lambda name: ascii(name)[:24],
)
def test_caller_ids_outside_the_grammar(field: Field, caller_id: str) -> None:
    """Reject a caller_id that is not a global name; `rosmaster` would accept any."""
    answer = field.rogue("registerPublisher", caller_id, "/shared/talk", "std_msgs/String", API)
    assert (answer[0], answer[2]) == (-1, []), answer
    assert "caller_id" in answer[1]
    assert field.rogue("setParam", caller_id, "/shared/x", 1)[0] == -1


def test_case_is_part_of_a_name(field: Field) -> None:
    """`/Voice` and `/voice` are different nodes, `/Chatter` and `/chatter` different topics."""
    assert field.rogue("getPid", "/Voice")[0] == 1
    answer = field.rogue("registerPublisher", "/Voice", "/Chatter", "std_msgs/String", API)
    field.denied(answer, "/Chatter", rule="[Publishers] default", resource="/Chatter")


@pytest.mark.parametrize("method", ["GETPID", "getpid", "getPid ", "system.getPid", "__class__", "_dispatch",
                                    "publisherUpdate", "paramUpdate", "x" * 4000, "requestTopic", ""])  # fmt: skip
def test_unknown_methods(field: Field, method: str) -> None:
    """Method names are matched exactly; unknown methods are denied and recorded."""
    answer = field.rogue(method or "\u00e9", "/caller")
    field.denied(answer, "is not a call that is served here")


def test_very_long_names_are_truncated_in_the_log(field: Field) -> None:
    """A name of a megabyte does not become a record of a megabyte."""
    answer = field.rogue("noSuchCall", "/" + "A" * 1_000_000)
    record = field.denied(answer, "'noSuchCall' is not a call")
    assert len(record["caller_id"]) <= 1024
    answer = field.rogue("getPid", "/" + "B" * 1_000_000)
    assert answer[0] == -1
    record = field.recorded(event="malformed", resource="getPid", host="10.77.0.66")
    assert len(record["caller_id"]) <= 1024
    assert len(record["reason"]) < 1000


# --- parameters ---


@pytest.mark.parametrize("key", ["/", "", "//", "/secret", "secret/key", "//secret//key/", "/run_id"])
def test_parameters_of_other_hosts(field: Field, key: str) -> None:
    """The root, and every parameter without a rule, can neither be set nor deleted, in any spelling."""
    for method, value in (("setParam", ({"a": 1},)), ("deleteParam", ())):
        answer = field.rogue(method, f"/writer_{key.replace('/', '_')}", key, *value)
        assert answer[0] in (0, -1), answer
        if key:
            field.denied(answer, "", rule="[Parameters] write default", resource=method)
    assert field.call(field.robot, "getParam", "/looker", "/secret/key")[2] == 4711


@pytest.mark.parametrize("key", ["/shared/fixed/x", "/shared//fixed/x/y/"])
def test_a_value_is_not_replaced_by_setting_a_child(field: Field, key: str) -> None:
    """`rosmaster` would replace the value, so setting a parameter below a value needs the right to write that value."""
    assert field.call(field.robot, "setParam", "/looker", "/shared/fixed", 4711)[0] == 1
    answer = field.rogue("setParam", "/writer_below", key, 0)
    field.denied(answer, "", rule="[Parameters] write /shared/fixed", resource="setParam")
    [[answer]] = field.rogue("system.multicall", [part("setParam", "/writer_within", key, 0)])
    field.denied(answer, "", rule="[Parameters] write /shared/fixed", resource="setParam")
    assert field.call(field.robot, "getParam", "/looker", "/shared/fixed")[2] == 4711


def test_a_right_to_a_key_does_not_cover_its_namespace(field: Field) -> None:
    """The right to set a key to a value does not cover a dictionary, or deleting other hosts' parameters below it."""
    assert field.rogue("setParam", "/writer_leaf", "/leaf", 1)[0] == 1
    answer = field.rogue("setParam", "/writer_leaf", "/leaf", {"a": 1})
    field.denied(answer, "", rule="[Parameters] write default", resource="setParam")
    assert field.call(field.robot, "setParam", "/looker", "/leaf/b", 4711)[0] == 1
    for method, value in (("setParam", (1,)), ("deleteParam", ())):
        answer = field.rogue(method, f"/writer_leaf_{method}", "/leaf", *value)
        field.denied(answer, "", rule="[Parameters] write default", resource=method)
    assert field.call(field.robot, "getParam", "/looker", "/leaf")[2] == {"b": 4711}


@pytest.mark.parametrize("key", ["/secret/key", "/secret", "/", "//secret/"])
def test_reading_a_secret(field: Field, key: str) -> None:
    """Neither a secret's key nor a namespace that contains the secret can be read, watched or searched for."""
    for method, parameters in (
        ("getParam", (key,)),
        ("hasParam", (key,)),
        ("subscribeParam", (API, key)),
    ):
        answer = field.rogue(method, "/reader" + key.replace("/", "_"), *parameters)
        record = field.denied(answer, "", rule="[Parameters] read /secret/**", resource=method)
        assert record["detail"]["key"].startswith("/")
        assert "4711" not in str(answer)


def test_secrets_are_not_listed(field: Field) -> None:
    """`getParamNames` and `searchParam` list readable parameters only."""
    assert "/secret/key" not in field.rogue("getParamNames", "/lister")[2]
    assert "/open_key" in field.rogue("getParamNames", "/lister")[2]
    for key in ("key", "other"):
        answer = field.rogue("searchParam", "/secret/inside", key)
        assert answer[0] == -1, answer
        assert "[Parameters] read /secret/**" in answer[1]
    assert field.rogue("searchParam", "/lister", "open_key")[2] == "/open_key"


def test_keys_with_slashes_inside_a_value(field: Field) -> None:
    """A dictionary with keys that look like paths is stored unchanged and reaches no other parameter."""
    value = {"a/b": 1, "..": 4, "secret/key": 5, "list": [{"/secret/key": 6}]}
    assert field.rogue("setParam", "/writer", "/shared/odd", value)[0] == 1
    assert field.call(field.robot, "getParam", "/looker", "/secret/key")[2] == 4711
    assert field.rogue("getParam", "/writer", "/shared/odd")[2] == value
    assert "/secret/key" not in field.rogue("getParamNames", "/writer")[2]
    assert field.rogue("deleteParam", "/writer", "/shared/odd")[0] == 1


@pytest.mark.parametrize("name", ["/limits/speed", "/limits", "~limits", "", "/", "a//b", "a/"])
def test_a_forged_update(field: Field, name: str) -> None:
    """Reject an update with a member that is not a relative name, so that watchers of other keys receive nothing."""
    watcher = field.ros.parameters("rospy", name="cautious")
    watcher.wait_for(event="ready")
    field.call(field.robot, "setParam", "/driver", "/limits/speed", 1)
    watcher.send(json.dumps({"do": "watch", "key": "/limits/speed"}))
    watcher.wait_for(event="done", do="watch", value=1)
    forged = {name: {"speed": 666}, "limits": 666, "limits/speed": 666}
    for value in (forged, {"limits": forged}):
        for answer in (
            field.rogue("setParam", "/forger", "/shared/forged", value),
            field.rogue("system.multicall", [part("setParam", "/forger", "/shared/forged", value)])[0][0],
        ):
            assert answer[0] == -1, answer
            assert "no relative name" in answer[1]
    field.recorded("no relative name", event="malformed", host="10.77.0.66", resource="setParam")
    assert field.rogue("setParam", "/forger", "/shared/forged", {"limits/speed": 666})[0] == 1
    assert field.rogue("deleteParam", "/forger", "/shared/forged")[0] == 1
    field.call(field.robot, "setParam", "/driver", "/limits/speed", 2)
    watcher.wait_for(event="changed", value=2)
    assert {event["value"] for event in watcher.seen(event="changed")} == {2}
    watcher.stop()


@pytest.mark.parametrize("value", [None, {"a": None}, [1, [None]], {"a": {"b": [{"c": None}]}}], ids=repr)
def test_nil_inside_a_value(field: Field, value: Any) -> None:
    """Reject `<nil/>` with an error for its sender only; stored, it would break every answer that contains it."""
    answer = field.rogue("setParam", "/writer", "/shared/nil", value)
    assert answer[0] == -1
    assert field.rogue("getParam", "/writer", "/shared")[0] == 1


def test_a_parameter_tree_that_is_too_deep(field: Field) -> None:
    """The total depth of keys and values is limited: `rosmaster` could not return a deeper tree."""
    value: Any = 1
    for _ in range(90):
        value = {"d": value}
    answer = field.rogue("setParam", "/writer", "/shared" + "/k" * 20, value)
    assert answer[0] == -1
    assert "nest deeper" in answer[1]
    assert field.rogue("setParam", "/writer", "/shared/" + "/".join("k" * 400), 1)[0] == -1
    for _ in range(20):
        value = [value]
    assert field.rogue("setParam", "/writer", "/shared/deep", value).faultCode == -32600
    assert field.call(field.robot, "getParam", "/looker", "/")[0] == 1


def test_integers_beyond_32_bits(field: Field) -> None:
    """An integer that ROS clients cannot read is a fault for its sender; the connection and other callers continue."""
    body = (
        "<?xml version='1.0'?><methodCall><methodName>setParam</methodName><params><param><value>/writer</value>"
        "</param><param><value>/shared/big</value></param><param><value><i4>4294967296</i4></value></param></params>"
        "</methodCall>"
    )
    request = f"POST / HTTP/1.1\r\nHost: m\r\nContent-Length: {len(body)}\r\n\r\n{body}"
    assert b"32 bits" in field.raw(request.encode())
    assert field.rogue("hasParam", "/writer", "/shared/big")[2] is False


@pytest.mark.parametrize(
    "value",
    [
        float("inf"),
        -0.0,
        "",
        "x" * 1_000_000,
        "\u4f60\u597d <&>]]>",
        True,
        [],
        {},
        [[[]]],
        2**31 - 1,
        -(2**31),
    ],
    ids=lambda value: repr(value)[:20],
)
def test_values_that_ros_accepts(field: Field, value: Any) -> None:
    """Unusual values that a plain ROS master accepts are stored and returned unchanged."""
    assert field.rogue("setParam", "/writer", "/shared/value", value)[0] == 1
    assert field.call(field.robot, "getParam", "/looker", "/shared/value")[2] == value


def test_bytes_and_dates(field: Field) -> None:
    """Binary values and dates are stored and returned."""
    from xmlrpc import client  # noqa: PLC0415 - only here

    for value in (client.Binary(b"\x00\xff"), client.DateTime("20250131T23:59:59")):
        assert field.rogue("setParam", "/writer", "/shared/value", value)[0] == 1
        assert field.call(field.robot, "getParam", "/looker", "/shared/value")[2] == value


def test_the_total_size_of_parameters_is_limited(field: Field) -> None:
    """The total size of parameters is limited; existing ones stay readable and can be deleted."""
    refused = None
    for number in range(12):
        answer = field.rogue("setParam", "/hoarder", f"/shared/hoard/p{number}", "x" * 7_000_000)
        assert isinstance(answer, list), answer
        if answer[0] != 1:
            refused = answer
            break
    assert refused is not None
    field.denied(refused, "bytes of parameters; the quota of one host is", event="limit exceeded")
    assert field.call(field.robot, "getParam", "/looker", "/open_key")[2] == 1
    assert field.rogue("deleteParam", "/hoarder", "/shared/hoard")[0] == 1
    assert field.rogue("setParam", "/hoarder", "/shared/small", 1)[0] == 1


# --- services ---


def test_forged_provider(field: Field) -> None:
    """Other hosts cannot offer a service of the robot."""
    answer = field.rogue("registerService", "/forger", "/negate", "rosrpc://10.77.0.66:40405", API)
    field.denied(answer, "/negate", rule="[Services] default", category="offer", resource="/negate")


def test_service_that_the_caller_may_not_call(field: Field) -> None:
    """A caller without the right to a service does not learn its address."""
    answer = field.rogue("lookupService", "/client", "/negate")
    field.denied(answer, "/negate", rule="[Clients] default", category="call", resource="/negate")
    assert answer[2] == ""


@pytest.mark.parametrize(
    "uri",
    ["rosrpc://10.77.0.66:0", "rosrpc://10.77.0.66:70000", "rosrpc://10.77.0.66", "http://10.77.0.66:9/", "rosrpc://",
     "rosrpc://u:p@10.77.0.66:9", "10.77.0.66:9", "rosrpc://10.77.0.66:9/path", "rosrpc://10.77.0.66:-1", 7],
    ids=repr,
)  # fmt: skip
def test_invalid_service_uris(field: Field, uri: Any) -> None:
    """A service URI needs the scheme rosrpc, a host and a port."""
    answer = field.rogue("registerService", "/provider", "/shared/mine", uri, API)
    assert (answer[0], answer[2]) == (-1, 0)
    assert "parameter [service_api]" in answer[1]


@pytest.mark.parametrize(
    "uri",
    ["http://10.77.0.66:0/", "rosrpc://10.77.0.66:40404", "https://10.77.0.66:40404/", "ftp://10.77.0.66:1/",
     "http://u:p@10.77.0.66:40404/", "http://10.77.0.66/", "http://:40404/", "http://10.77.0.66:99999/",
     "http://10.77.0.66:40404/?x=1", "http://10.77.0.66:40404#f", "http://10.77.0.66:4e1/", "http://[::1", "", 7,
     "http://10.77.0.66:40404/\r\nX: y", "file:///etc/passwd", "http://" + "a" * 2000 + ":1/"],
    ids=lambda uri: repr(uri)[:32],
)  # fmt: skip
def test_invalid_node_uris(field: Field, uri: Any) -> None:
    """A node URI needs the scheme http, a host and a port; ambiguous spellings are rejected."""
    answer = field.rogue("registerPublisher", "/wrong", "/shared/talk", "std_msgs/String", uri)
    assert (answer[0], answer[2]) == (-1, [])
    assert "parameter [caller_api]" in answer[1]


# --- addresses ---


def test_uri_of_a_third_machine(field: Field) -> None:
    """A URI that names a third machine causes no call there: the caller's own address is called."""
    with Impostor(field.unknown_host, answering([1, "", 0])) as third:
        home = field.attacker.run(lambda: socket.create_server(("10.77.0.66", third.port)))
        with home:
            home.settimeout(LIMIT)
            answer = field.rogue(
                "registerSubscriber", "/pointer", "/shared/talk", "std_msgs/String", third.uri
            )
            assert answer[0] == 1
            assert third.uri not in answer[2]
            talker = field.ros.talker("rospy", "/shared/talk", name="second_shared_voice")  # causes an update
            for expected in (b"", b"POST /"):  # first RVMaster looks whether a node listens there
                connection, peer = home.accept()
                with connection:
                    assert peer[0] == "10.77.0.2"
                    assert expected in connection.recv(4096)
            talker.stop()
        assert third.peers == []


def test_service_of_a_third_machine(field: Field) -> None:
    """A service URI that names a third machine leads to the caller's own host only."""
    with (
        Impostor(field.unknown_host, answering([1, "", 0])) as third,
        Impostor(field.attacker, answering([1, "", 0])) as node,
    ):
        uri = f"rosrpc://10.77.0.99:{third.port}"
        assert field.rogue("registerService", "/pointer2", "/shared/away", uri, node.uri)[0] == 1
        home = field.attacker.run(lambda: socket.create_server(("10.77.0.66", third.port)))
        with home:
            home.settimeout(LIMIT)
            code, _text, found = field.call(field.robot, "lookupService", "/looker", "/shared/away")
            assert code == 1
            host, _, port = found.removeprefix("rosrpc://").partition(":")
            assert host == "10.77.0.2"
            with field.connect(field.robot, int(port)) as client:
                client.sendall(header(callerid="/looker", service="/shared/away", md5sum="*", type="*"))
                connection, peer = home.accept()
                connection.close()
                assert peer[0] == "10.77.0.2"
        assert third.peers == []
        assert field.rogue("unregisterService", "/pointer2", "/shared/away", uri)[0] == 1


@pytest.mark.parametrize("name", ["/listener", "/voice", "", "/caller\x1b[2J", "caller", "/other"])
def test_forged_name_of_a_service_client(field: Field, name: str) -> None:
    """A client must call under the name of its lookup; any other name is denied and recorded."""
    code, _text, uri = field.rogue("lookupService", "/caller", "/shared/negate")
    assert code == 1
    port = int(uri.rpartition(":")[2])
    answer = knock(field, port, header(callerid=name, service="/shared/negate", md5sum="*"))
    reason = "no grant for" if name.startswith("/") and name.isprintable() else "is not a global ROS name"
    assert reason.encode() in answer
    field.recorded(reason, host="10.77.0.66", decision="deny")
    answer = knock(field, port, header(callerid="/caller", service="/shared/negate", md5sum="*"))
    assert b"callerid=/shared_negator" in answer


def test_header_that_a_service_receives(field: Field) -> None:
    """A service receives the name of the lookup and ROS's own fields; a probe by another tool gets the same answer."""
    api = Impostor(field.robot, answering([1, "", 4711]))  # without one, control finds the node dead
    with api, field.robot.run(lambda: socket.create_server(("10.77.0.10", 0))) as home:
        home.settimeout(LIMIT)
        place = f"rosrpc://10.77.0.10:{home.getsockname()[1]}"
        provider = ("/seer", "/shared/see", place)
        assert field.call(field.robot, "registerService", *provider, api.uri)[0] == 1
        uri = field.rogue("lookupService", "/caller", "/shared/see")[2]
        for given, seen in (
            ({"callerid": "/caller", "persistent": "1"}, {"persistent": "1"}),
            ({"callerid": "/rosservice", "probe": "1"}, {"probe": "1"}),
        ):
            with field.connect(port=int(uri.rpartition(":")[2])) as client:
                fields = given | {"service": "/shared/see", "md5sum": "*"}
                client.sendall(header(**fields, admin="yes", _bad="\x1b"))
                connection, _peer = home.accept()
                with connection:
                    told = HeaderParser().feed(connection.recv(65536))
                assert told == {"callerid": "/caller", "service": "/shared/see", "md5sum": "*"} | seen
        assert field.call(field.robot, "unregisterService", *provider)[0] == 1


def header(**fields: str) -> bytes:
    """Return a TCPROS connection header."""
    body = b"".join(
        len(one).to_bytes(4, "little") + one
        for one in (f"{key}={value}".encode() for key, value in fields.items())
    )
    return len(body).to_bytes(4, "little") + body


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "127.0.1.1", "[::1]", "LOCALHOST"])
@pytest.mark.parametrize(
    "method", ["registerPublisher", "registerSubscriber", "subscribeParam", "registerService"]
)
def test_node_on_its_own_loopback(field: Field, method: str, host: str) -> None:
    """A node started with ROS_IP=localhost is not registered; its error names the cause and the remedy."""
    api = f"http://{host}:27404/"  # no port that the kernel or the appliance may choose
    parameters = {
        "registerPublisher": ("/shared/talk", "std_msgs/String", api),
        "registerSubscriber": ("/shared/talk", "std_msgs/String", api),
        "subscribeParam": (api, "/shared/x"),
        "registerService": ("/shared/s", f"rosrpc://{host}:9", api),
    }[method]
    answer = field.rogue(method, "/homebody", *parameters)
    field.denied(answer, "start it with ROS_IP=10.77.0.66", caller_id="/homebody")


def test_real_node_on_its_own_loopback(field: Field) -> None:
    """An unmodified rospy node with ROS_IP=127.0.0.1 prints this advice."""
    node = field.ros.on(field.attacker).start(
        ["/usr/bin/rostopic", "pub", "/shared/home", "std_msgs/String", "data: x"],
        label="rostopic pub",
        ROS_IP="127.0.0.1",
    )
    field.recorded(event="decision", decision="deny", resource="/shared/home", category="publish")
    node.stop()


# --- the node API, bypassing the master ---


@pytest.mark.parametrize(
    ("method", "parameters"),
    [("publisherUpdate", ("/chatter", ["http://10.77.0.66:40404/"])), ("paramUpdate", ("/x", 1))],
)
def test_posing_as_the_master(field: Field, method: str, parameters: tuple[Any, ...]) -> None:
    """Deny updates from hosts other than the master, under any name."""
    uri = outer(field, "/ear")
    for name in ("/master", "/rogue_master"):
        answer = field.rogue(method, name, *parameters, uri=uri)
        field.denied(answer, f"'{method}' is not a call that is served here", caller_id=name)


def test_killing_a_node(field: Field) -> None:
    """Calling `shutdown` of another host's node needs the rule for this command."""
    answer = field.rogue("shutdown", "/killer", "die", uri=outer(field, "/voice"))
    field.denied(answer, "shutdown", rule="[Commands] shutdown", resource="shutdown")


def test_stopping_the_master(field: Field) -> None:
    """The `default` rule does not grant `shutdown` of the master."""
    answer = field.rogue("shutdown", "/killer", "die")
    field.denied(answer, "shutdownMaster", resource="shutdownMaster")


def test_topic_without_the_right(field: Field) -> None:
    """Deny `requestTopic` on a node's endpoint like a subscription, without revealing a port."""
    answer = field.rogue("requestTopic", "/spy", "/chatter", TCPROS, uri=outer(field, "/voice"))
    field.denied(answer, "/chatter", rule="[Subscribers] default", resource="/chatter", category="subscribe")
    assert answer[2] == []


@pytest.mark.parametrize(
    ("protocols", "code", "words"),
    [
        ([["UDPROS", b"x", "10.77.0.66", 4, 1500]], 0, "only TCPROS"),
        ([[]], 0, "only TCPROS"),
        ([[["TCPROS"]]], 0, "only TCPROS"),
        ([], -1, "a list that is not empty"),
        (["TCPROS"], -1, "a list of protocols"),
        ([7], -1, "a list of protocols"),
    ],
    ids=repr,
)
def test_other_protocols(field: Field, protocols: Any, code: int, words: str) -> None:
    """Only TCPROS is relayed; a request for other protocols, or for none, gets rospy's answer, without a port."""
    answer = field.rogue("requestTopic", "/udp", "/shared/talk", protocols, uri=outer(field, "/shared_voice"))
    assert (answer[0], answer[2]) == (code, [])
    assert words in answer[1]


def test_topic_that_the_node_does_not_publish(field: Field) -> None:
    """A right to a topic does not make a node publish it."""
    answer = field.rogue("requestTopic", "/asker", "/shared/other", TCPROS, uri=outer(field, "/voice"))
    assert (answer[0], answer[2]) == (-1, []), "as by rospy"


# --- the relay's ports ---


def relay_port(field: Field) -> int:
    """Return the relay port of `/shared_voice`, with a permission for `/taker`."""
    code, _text, protocol = field.rogue(
        "requestTopic", "/taker", "/shared/talk", TCPROS, uri=outer(field, "/shared_voice")
    )
    assert code == 1
    return int(protocol[2])


def knock(field: Field, port: int, data: bytes) -> bytes:
    """Return the relay's first bytes after a connection header, or nothing if it closes."""
    with field.connect(port=port) as sock:
        sock.sendall(data)
        with contextlib.suppress(ConnectionResetError):
            return sock.recv(65536)
        return b""


STRING = {"type": "std_msgs/String", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1"}


def test_granted_topic_arrives(field: Field) -> None:
    """With the permission the connection is served, so the denials in the tests below have the intended reason."""
    answer = knock(field, relay_port(field), header(callerid="/taker", topic="/shared/talk", **STRING))
    assert b"callerid=/shared_voice" in answer


@pytest.mark.parametrize(
    "fields",
    [
        {"callerid": "/nobody", "topic": "/shared/talk"},
        {"callerid": "/taker", "topic": "/chatter"},
        {"callerid": "/taker", "topic": "/rosout"},
        {"callerid": "/ear", "topic": "/chatter"},
        {"callerid": "/taker", "service": "/negate"},
        {"callerid": "/taker"},
        {"topic": "/shared/talk"},
    ],
    ids=lambda fields: " ".join(fields.values()),
)
def test_relay_port_without_the_grant(field: Field, fields: dict[str, str]) -> None:
    """A known relay port serves only topics that were permitted to this host and name."""
    answer = knock(field, relay_port(field), header(**fields, **STRING))
    assert b"callerid=/shared_voice" not in answer
    assert b"hello" not in answer
    field.recorded(event="connection refused", host="10.77.0.66")


def test_guessed_relay_port(field: Field) -> None:
    """A guessed relay port of a victim's node is useless without a permission for this host."""
    uri = outer(field, "/voice")
    port = int(uri.rsplit(":", 1)[1].rstrip("/")) + 1  # two ports for each node
    answer = knock(field, port, header(callerid="/ear", topic="/chatter", **STRING))
    assert b"hello" not in answer
    assert b"callerid=/voice" not in answer


def test_permission_of_another_host(field: Field) -> None:
    """A permission is bound to the requesting host: the same name on another host is denied."""
    uri = field.call(field.ocu, "lookupNode", "/looker2", "/voice")[2]
    code, _text, protocol = field.call(field.ocu, "requestTopic", "/borrowed", "/chatter", TCPROS, uri=uri)
    assert code == 1
    answer = knock(field, protocol[2], header(callerid="/borrowed", topic="/chatter", **STRING))
    assert b"hello" not in answer
    assert b"callerid=/voice" not in answer
    record = field.recorded(event="connection refused", host="10.77.0.66", caller_id="/borrowed")
    why = field.appliance.rosrv("audit", "why", record["id"]).stdout.splitlines()
    assert any(line.startswith("would be allowed by: /chatter = ") for line in why), why


# --- hidden hosts and ports ---


def test_host_that_no_rule_names(field: Field) -> None:
    """An unknown host gets a fault with the reason, and its request is recorded."""
    answer = field.call(field.unknown_host, "getPid", "/unknown")
    assert "no rule of the policy names 10.77.0.99" in answer.faultString
    record = field.recorded(host="10.77.0.99", decision="deny", resource="getPid", caller_id="/unknown")
    assert record["detail"] == {"call": "getPid", "unknown_host": True}
    field.call(field.unknown_host, "registerPublisher", "/evil", "/shared/x", "std_msgs/String", field.api)
    field.recorded(host="10.77.0.99", category="publish", resource="/shared/x", caller_id="/evil")
    wider = field.home / "wider.ini"
    wider.write_text("[Publishers]\n/shared/x = 10.77.0.99\n[Nodes]\ndefault = *\n")
    differs = field.appliance.rosrv(
        "policy", "diff", str(field.appliance.policy_file), str(wider), "--decisions", check=False
    ).stdout
    assert any("/shared/x" in line and "10.77.0.99" in line for line in differs.splitlines()), differs
    face = outer(field, "/voice")
    answer = field.call(field.unknown_host, "getPid", "/unknown", uri=face)
    assert "no rule of the policy names 10.77.0.99" in answer.faultString


def test_port_scan(field: Field) -> None:
    """From other hosts only RVMaster, the nodes' endpoints and the relay's ports answer."""
    hidden = {port for address, port in field.middle.run(_listening) if address == LOOPBACK}
    assert hidden, "rosmaster and the master-side endpoints listen somewhere"
    scanned = field.attacker.run(lambda: scan("10.77.0.2", range(1, 65536), 0.3))
    open_ports = set(scanned.open)
    assert 11311 in open_ports
    assert {port for port in open_ports if not 19001 <= port <= 26000} == {11311}
    assert not open_ports & hidden


def _listening() -> set[tuple[str, int]]:
    """Return (address, port) of all listening sockets of this namespace, as in /proc."""
    table = Path("/proc/thread-self/net/tcp").read_text(encoding="ascii")
    rows = [line.split() for line in table.splitlines()[1:]]
    return {(row[1].split(":")[0], int(row[1].split(":")[1], 16)) for row in rows if row[3] == "0A"}


def test_loopback_listeners_from_another_host(field: Field) -> None:
    """Listeners for `rosmaster` and for the appliance's own nodes are on loopback and unreachable from other hosts."""
    hidden = {port for address, port in field.middle.run(_listening) if address == LOOPBACK}
    for port in hidden:
        with pytest.raises(OSError, match=r"timed out|refused|unreachable"):
            field.attacker.run(partial(socket.create_connection, ("10.77.0.2", port), 0.5))


# --- dishonest peers ---


def silent(_connection: socket.socket, _request: bytes) -> None:
    """Never answer."""
    threading.Event().wait(60)


def endless(connection: socket.socket, _request: bytes) -> None:
    """Send two gigabytes."""
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: 2147483648\r\n\r\n")
    for _ in range(2048):
        connection.sendall(b" " * (1 << 20))


def twice(connection: socket.socket, _request: bytes) -> None:
    """Send two answers to one request."""
    connection.sendall(response([1, "", 1]) + response([1, "", 2]))


def rubbish(connection: socket.socket, _request: bytes) -> None:
    """Send bytes that are not HTTP."""
    connection.sendall(b"\x00\xff" * 1000)


def redirect(connection: socket.socket, _request: bytes) -> None:
    """Redirect the caller to a third machine."""
    connection.sendall(
        b"HTTP/1.1 302 Found\r\nLocation: http://10.77.0.99:4444/\r\nContent-Length: 0\r\n\r\n"
    )


def drip(connection: socket.socket, _request: bytes) -> None:
    """Send one byte at a time, slowly, without end."""
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 100000\r\n\r\n")
    pause = threading.Event()
    for _ in range(600):
        connection.sendall(b" ")
        pause.wait(0.1)


def bomb(connection: socket.socket, _request: bytes) -> None:
    """Send XML with an entity that expands."""
    body = b'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]><methodResponse/>'
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % len(body) + body)


@pytest.mark.parametrize(
    "behave", [silent, endless, twice, rubbish, redirect, drip, bomb], ids=lambda one: one.__name__
)
def test_misbehaving_node(field: Field, behave: Any) -> None:
    """A misbehaving node of the rogue harms only itself: its callers get a well-formed answer.

    If the node gives no answer, they get a closed connection, as from a node that does not exist.
    """
    before = field.memory()
    with Impostor(field.attacker, behave) as node:
        name, topic = f"/liar_{behave.__name__}", f"/shared/liar_{behave.__name__}"
        assert field.rogue("registerPublisher", name, topic, "std_msgs/String", node.uri)[0] == 1
        uri = outer(field, name)
        answers: list[Any] = []

        def ask() -> None:
            try:
                answers.append(field.rogue("getPid", "/asker", uri=uri))
            except ConnectionError as error:
                answers.append(error)

        asking = threading.Thread(target=ask)
        asking.start()
        assert node.called.wait(LIMIT)
        field.unharmed(20)
        asking.join(LIMIT)
        [answer] = answers
        assert isinstance(answer, ConnectionError) != (behave is twice)
        if behave is twice:
            assert len(answer) == 3
            assert isinstance(answer[1], str)
        assert f":{node.port}" not in str(answer)
    assert field.memory() < before + (100 << 20)
