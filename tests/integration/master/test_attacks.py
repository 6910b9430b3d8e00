"""Attacks on the graph from another host, by calls: identity, names, parameters, services, addresses, faces.

After each of them the robot's talker and its operator's listener have gone on (the fixture looks), the caller was
told why in the shape its library expects, and the audit log has the refusal with the rule it stands on.
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
    """More of a graph: a secret, a service, a topic that everybody may have."""
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
def nothing_hidden_is_revealed(field: Field) -> Iterator[None]:
    """In nothing that the rogue is told by a test is a port of the ROSMaster's, of a face it has, or of a real node."""
    since = len(field.answers)
    yield
    hidden = {port for address, port in field.middle.run(_listening) if address == LOOPBACK}
    real = {port for _, port in field.robot.run(_listening)} | {port for _, port in field.ocu.run(_listening)}
    assert hidden and real
    for method, answer in field.answers[since:]:
        text = answer.decode("latin-1") if isinstance(answer, bytes) else str(answer)
        told = {int(port) for port in re.findall(rf"(?<!{ROGUE}):(\d+)\b", text)}  # what is his own he knows
        assert not told & (hidden | real), f"{method} told of {told & (hidden | real)}: {text[:500]}"
        assert not re.search(r"\b[0-9a-f]{32}\b", text), f"{method} told a key: {text[:500]}"


def outer(field: Field, node: str) -> str:
    """Where the rogue is told a node is."""
    code, _text, uri = field.rogue("lookupNode", "/looker", node)
    assert code == 1
    return str(uri)


# --- who speaks ---


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
def test_speaking_for_another_hosts_node(
    field: Field, method: str, parameters: tuple[Any, ...], category: str
) -> None:
    """No call of the Master API can be made in the name of a node that lives on another host."""
    answer = field.rogue(method, "/voice", *parameters)
    allowed_but_held = {"subscribeParam": "is held by", "unsubscribeParam": "is held by"}
    told = allowed_but_held.get(method, VOICE_TOLD)
    record = field.denied(
        answer, told, in_record="is held by 10.77.0.10", caller_id="/voice", category=category
    )
    assert record["detail"]["call"] == method


@pytest.mark.parametrize("method", ["registerPublisher", "registerSubscriber"])
def test_takeover_of_a_running_node(field: Field, method: str) -> None:
    """A node that runs on another host keeps its name, though the policy grants it to both."""
    answer = field.rogue(method, "/voice", "/shared/talk", "std_msgs/String", API)
    field.denied(answer, "/voice is held by a running node of another host", in_record="node on 10.77.0.10")
    assert answer[2] == []


def test_takeover_by_offering_a_service(field: Field) -> None:
    """Nor is it taken by a service."""
    answer = field.rogue("registerService", "/voice", "/shared/s", "rosrpc://10.77.0.66:9", API)
    held = "/voice is held by a running node"
    field.denied(answer, f"{held} of another host", in_record=f"{held} on 10.77.0.10", category="offer")


def test_name_that_the_policy_keeps(field: Field) -> None:
    """A free name that `[Nodes]` grants to others cannot be used at all."""
    answer = field.rogue("registerPublisher", "/guarded_1", "/shared/talk", "std_msgs/String", API)
    field.denied(answer, "/guarded_1", rule="[Nodes] /guarded_*", category="publish")


def test_name_of_the_appliances_own_node(field: Field) -> None:
    """`/rosout` is the appliance's."""
    answer = field.rogue("registerPublisher", "/rosout", "/shared/talk", "std_msgs/String", API)
    field.denied(answer, "the name /rosout belongs to the appliance")


def test_what_nodes_log_is_collected(field: Field) -> None:
    """The rosout aggregator hears every node, though the policy names neither it nor this machine."""
    for name in ("voice", "ear"):
        field.recorded(f"is connected to /rosout of /{name}", event="connection opened", caller_id="/rosout")


@pytest.mark.parametrize("method", ["getPid", "getName", "getUri", "getMasterUri", "getBusInfo", "getBusStats",
                                    "getSubscriptions", "getPublications"])  # fmt: skip
def test_speaking_for_a_node_to_a_node(field: Field, method: str) -> None:
    """On another node's face nobody can use the name of a node of another host either."""
    answer = field.rogue(method, "/ear", uri=outer(field, "/shared_voice"))
    record = field.denied(answer, "/ear is held by", in_record="/ear is held by 10.77.0.20", caller_id="/ear")
    assert record["detail"]["node"] == "/shared_voice"


def test_asking_for_a_topic_in_anothers_name(field: Field) -> None:
    """The subscriber's name on `requestTopic` is bound to its host."""
    uri = outer(field, "/shared_voice")
    answer = field.rogue("requestTopic", "/ear", "/shared/talk", TCPROS, uri=uri)
    field.denied(answer, "/ear is held by", in_record="/ear is held by 10.77.0.20")


def test_late_call_of_a_replaced_node(field: Field) -> None:
    """A node that was replaced under its name on the same host cannot unregister its successor, nor come back."""
    with (
        Impostor(field.attacker, answering([1, "", 0])) as old,
        Impostor(field.attacker, answering([1, "", 7])) as new,
    ):
        for one in (old, new):
            assert (
                field.rogue("registerPublisher", "/twin", "/shared/twin", "std_msgs/String", one.uri)[0] == 1
            )
        assert old.called.wait(LIMIT)  # ROSMaster tells it to shut down, through the appliance
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
    """Knowing a victim's real URI does not help: the caller is who he is by his address."""
    uri = field.talker.seen(event="ready")[0]["uri"]
    answer = field.rogue("unregisterPublisher", "/another", "/shared/talk", uri)
    assert answer[:1] == [1]  # ROSMaster's "not a registered node"
    assert "not a registered node" in answer[1]
    answer = field.rogue("unregisterPublisher", "/voice", "/shared/talk2", uri)
    field.denied(answer, VOICE_TOLD, in_record=VOICE_HELD)


# --- multicall ---


def part(method: str, *params: Any) -> dict[str, Any]:
    """One part of a multicall."""
    return {"methodName": method, "params": list(params)}


def test_multicall_is_decided_part_by_part(field: Field) -> None:
    """What is allowed does not carry what is not."""
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


def test_multicall_inside_a_multicall(field: Field) -> None:
    """Nesting is refused, recorded, and the parts inside are not carried out."""
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
def test_multicall_of_another_form(field: Field, parts: Any) -> None:
    """Anything else than a list of calls is an error of its form, not of the appliance."""
    answer = field.rogue("system.multicall", parts)
    assert "multicall" in str(answer)
    field.recorded(event="malformed", host="10.77.0.66", resource="system.multicall")


def test_multicall_on_a_nodes_face(field: Field) -> None:
    """A node serves no multicall; so does its face."""
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
    """Whatever ROSMaster would take for `/chatter` is decided as `/chatter`."""
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
    """A name that looks like another, or that ROSMaster would take to pieces, never gets there."""
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
        "//voice",
        "/voice/",
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
    """A caller_id, which ROSMaster takes as it comes, is a global name or nothing."""
    answer = field.rogue("registerPublisher", caller_id, "/shared/talk", "std_msgs/String", API)
    assert (answer[0], answer[2]) == (-1, []), answer
    assert "caller_id" in answer[1]
    assert field.rogue("setParam", caller_id, "/shared/x", 1)[0] == -1


def test_case_is_part_of_a_name(field: Field) -> None:
    """`/Voice` is another node than `/voice`, and `/Chatter` another topic than `/chatter`."""
    assert field.rogue("getPid", "/Voice")[0] == 1
    answer = field.rogue("registerPublisher", "/Voice", "/Chatter", "std_msgs/String", API)
    field.denied(answer, "/Chatter", rule="[Publishers] default", resource="/Chatter")


@pytest.mark.parametrize("method", ["GETPID", "getpid", "getPid ", "system.getPid", "__class__", "_dispatch",
                                    "publisherUpdate", "paramUpdate", "x" * 4000, "requestTopic", ""])  # fmt: skip
def test_calls_that_are_none(field: Field, method: str) -> None:
    """The method's name is matched exactly; what is not in the table is refused and recorded."""
    answer = field.rogue(method or "\u00e9", "/caller")
    field.denied(answer, "is not a call that is served here")


def test_very_long_claims_are_cut_in_the_log(field: Field) -> None:
    """A megabyte where a name should be does not become a megabyte of audit log."""
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
def test_parameters_of_others(field: Field, key: str) -> None:
    """The root, and everything that is not granted, can neither be set nor deleted, however it is spelled."""
    for method, value in (("setParam", ({"a": 1},)), ("deleteParam", ())):
        answer = field.rogue(method, f"/writer_{key.replace('/', '_')}", key, *value)
        assert answer[0] in (0, -1), answer
        if key:
            field.denied(answer, "", rule="[Parameters] write default", resource=method)
    assert field.call(field.robot, "getParam", "/looker", "/secret/key")[2] == 4711


@pytest.mark.parametrize("key", ["/shared/fixed/x", "/shared//fixed/x/y/"])
def test_a_parameter_is_not_replaced_from_below(field: Field, key: str) -> None:
    """ROSMaster puts a namespace where something below a value is set: that is a write of the value."""
    assert field.call(field.robot, "setParam", "/looker", "/shared/fixed", 4711)[0] == 1
    answer = field.rogue("setParam", "/writer_below", key, 0)
    field.denied(answer, "", rule="[Parameters] write /shared/fixed", resource="setParam")
    [[answer]] = field.rogue("system.multicall", [part("setParam", "/writer_within", key, 0)])
    field.denied(answer, "", rule="[Parameters] write /shared/fixed", resource="setParam")
    assert field.call(field.robot, "getParam", "/looker", "/shared/fixed")[2] == 4711


def test_a_key_is_no_right_to_a_namespace(field: Field) -> None:
    """What one may set to a value, one may neither set to a dictionary nor delete while others have something in it."""
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
    """Neither the key nor a namespace that holds it can be read, watched or asked for."""
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
    """`getParamNames` and `searchParam` show what may be read."""
    assert "/secret/key" not in field.rogue("getParamNames", "/lister")[2]
    assert "/open_key" in field.rogue("getParamNames", "/lister")[2]
    for key in ("key", "other"):
        answer = field.rogue("searchParam", "/secret/inside", key)
        assert answer[0] == -1, answer
        assert "[Parameters] read /secret/**" in answer[1]
    assert field.rogue("searchParam", "/lister", "open_key")[2] == "/open_key"


def test_keys_with_slashes_inside_a_value(field: Field) -> None:
    """A dictionary whose keys look like paths stays where it was put; nothing else is reached by it."""
    value = {"a/b": 1, "..": 4, "secret/key": 5, "list": [{"/secret/key": 6}]}
    assert field.rogue("setParam", "/writer", "/shared/odd", value)[0] == 1
    assert field.call(field.robot, "getParam", "/looker", "/secret/key")[2] == 4711
    assert field.rogue("getParam", "/writer", "/shared/odd")[2] == value
    assert "/secret/key" not in field.rogue("getParamNames", "/writer")[2]
    assert field.rogue("deleteParam", "/writer", "/shared/odd")[0] == 1


@pytest.mark.parametrize("name", ["/limits/speed", "/limits", "~limits", "", "/", "a//b", "a/"])
def test_a_forged_update(field: Field, name: str) -> None:
    """A member whose name is no relative name is refused: no node that watches another key hears of it."""
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
def test_nothing_inside_a_value(field: Field, value: Any) -> None:
    """`<nil/>`, which would break every answer it is in, is refused for its sender alone."""
    answer = field.rogue("setParam", "/writer", "/shared/nil", value)
    assert answer[0] == -1
    assert field.rogue("getParam", "/writer", "/shared")[0] == 1


def test_a_tree_too_deep_to_be_told(field: Field) -> None:
    """Deep keys and deep values together are bounded: ROSMaster could not answer for the whole tree any more."""
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
    """What no ROS client could read back is a fault for its sender; the connection and the others go on."""
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
    """Odd values that a plain ROSMaster takes are taken and come back as they were."""
    assert field.rogue("setParam", "/writer", "/shared/value", value)[0] == 1
    assert field.call(field.robot, "getParam", "/looker", "/shared/value")[2] == value


def test_bytes_and_dates(field: Field) -> None:
    """Binary values and dates are values, too."""
    from xmlrpc import client  # noqa: PLC0415 - only here

    for value in (client.Binary(b"\x00\xff"), client.DateTime("20250131T23:59:59")):
        assert field.rogue("setParam", "/writer", "/shared/value", value)[0] == 1
        assert field.call(field.robot, "getParam", "/looker", "/shared/value")[2] == value


def test_more_parameters_than_anybody_needs(field: Field) -> None:
    """All parameters together are bounded; what is there stays readable, and can be deleted."""
    refused = None
    for number in range(12):
        answer = field.rogue("setParam", "/hoarder", f"/shared/hoard/p{number}", "x" * 7_000_000)
        assert isinstance(answer, list), answer
        if answer[0] != 1:
            refused = answer
            break
    assert refused is not None
    field.denied(refused, "bytes of parameters; the share of one host is", event="limit exceeded")
    assert field.call(field.robot, "getParam", "/looker", "/open_key")[2] == 1
    assert field.rogue("deleteParam", "/hoarder", "/shared/hoard")[0] == 1
    assert field.rogue("setParam", "/hoarder", "/shared/small", 1)[0] == 1


# --- services ---


def test_forged_provider(field: Field) -> None:
    """A service of the robot's cannot be offered by anybody else."""
    answer = field.rogue("registerService", "/forger", "/negate", "rosrpc://10.77.0.66:40405", API)
    field.denied(answer, "/negate", rule="[Services] default", category="offer", resource="/negate")


def test_service_that_may_not_be_called(field: Field) -> None:
    """Who may not call a service does not learn where it is."""
    answer = field.rogue("lookupService", "/client", "/negate")
    field.denied(answer, "/negate", rule="[Clients] default", category="call", resource="/negate")
    assert answer[2] == ""


@pytest.mark.parametrize(
    "uri",
    ["rosrpc://10.77.0.66:0", "rosrpc://10.77.0.66:70000", "rosrpc://10.77.0.66", "http://10.77.0.66:9/", "rosrpc://",
     "rosrpc://u:p@10.77.0.66:9", "10.77.0.66:9", "rosrpc://10.77.0.66:9/path", "rosrpc://10.77.0.66:-1", 7],
    ids=repr,
)  # fmt: skip
def test_service_uris_that_are_none(field: Field, uri: Any) -> None:
    """A service's URI has the scheme rosrpc, a host and a port."""
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
def test_node_uris_that_are_none(field: Field, uri: Any) -> None:
    """A node's API URI is http, with a host and a port, and nothing that two parsers read in two ways."""
    answer = field.rogue("registerPublisher", "/wrong", "/shared/talk", "std_msgs/String", uri)
    assert (answer[0], answer[2]) == (-1, [])
    assert "parameter [caller_api]" in answer[1]


# --- addresses ---


def test_uri_of_a_third_machine(field: Field) -> None:
    """A URI that names another machine makes nobody call it: the caller's own address is called."""
    with Impostor(field.stranger, answering([1, "", 0])) as third:
        home = field.attacker.run(lambda: socket.create_server(("10.77.0.66", third.port)))
        with home:
            home.settimeout(LIMIT)
            answer = field.rogue(
                "registerSubscriber", "/pointer", "/shared/talk", "std_msgs/String", third.uri
            )
            assert answer[0] == 1
            assert third.uri not in answer[2]
            talker = field.ros.talker("rospy", "/shared/talk", name="second_shared_voice")  # makes an update
            connection, peer = home.accept()
            with connection:
                assert peer[0] == "10.77.0.2"
                assert b"POST /" in connection.recv(4096)
            talker.stop()
        assert third.peers == []


def test_service_of_a_third_machine(field: Field) -> None:
    """A service URI that names another machine leads to the caller's own host, and to nobody else."""
    with (
        Impostor(field.stranger, answering([1, "", 0])) as third,
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
    """A client calls under the name that it has looked the service up by; another is refused, and recorded."""
    code, _text, uri = field.rogue("lookupService", "/caller", "/shared/negate")
    assert code == 1
    port = int(uri.rpartition(":")[2])
    answer = knock(field, port, header(callerid=name, service="/shared/negate", md5sum="*"))
    reason = "no grant for" if name.startswith("/") and name.isprintable() else "is not a global ROS name"
    assert reason.encode() in answer
    field.recorded(reason, host="10.77.0.66", decision="deny")
    answer = knock(field, port, header(callerid="/caller", service="/shared/negate", md5sum="*"))
    assert b"callerid=/shared_negator" in answer


def test_what_a_service_sees_of_its_client(field: Field) -> None:
    """The name that was looked up with and ROS's own fields; who probes as another tool does is told the same."""
    with field.robot.run(lambda: socket.create_server(("10.77.0.10", 0))) as home:
        home.settimeout(LIMIT)
        place = f"rosrpc://10.77.0.10:{home.getsockname()[1]}"
        provider = ("/seer", "/shared/see", place)
        assert field.call(field.robot, "registerService", *provider, "http://10.77.0.10:40405/")[0] == 1
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
    """A TCPROS connection header."""
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
    """A node started with ROS_IP=localhost is told what is wrong and what to do, not registered and then lost."""
    api = f"http://{host}:40404/"
    parameters = {
        "registerPublisher": ("/shared/talk", "std_msgs/String", api),
        "registerSubscriber": ("/shared/talk", "std_msgs/String", api),
        "subscribeParam": (api, "/shared/x"),
        "registerService": ("/shared/s", f"rosrpc://{host}:9", api),
    }[method]
    answer = field.rogue(method, "/homebody", *parameters)
    field.denied(answer, "start it with ROS_IP=10.77.0.66", caller_id="/homebody")


def test_real_node_on_its_own_loopback(field: Field) -> None:
    """An unmodified rospy node with ROS_IP=127.0.0.1 shows the advice to whoever started it."""
    node = field.ros.on(field.attacker).start(
        ["/usr/bin/rostopic", "pub", "/shared/home", "std_msgs/String", "data: x"],
        label="rostopic pub",
        ROS_IP="127.0.0.1",
    )
    field.recorded(event="decision", decision="deny", resource="/shared/home", category="publish")
    node.stop()


# --- the node API, past the master ---


@pytest.mark.parametrize(
    ("method", "parameters"),
    [("publisherUpdate", ("/chatter", ["http://10.77.0.66:40404/"])), ("paramUpdate", ("/x", 1))],
)
def test_posing_as_the_master(field: Field, method: str, parameters: tuple[Any, ...]) -> None:
    """Only the master sends updates: nobody else, by whatever name."""
    uri = outer(field, "/ear")
    for name in ("/master", "/rogue_master"):
        answer = field.rogue(method, name, *parameters, uri=uri)
        field.denied(answer, f"'{method}' is not a call that is served here", caller_id=name)


def test_killing_a_node(field: Field) -> None:
    """`shutdown` of another host's node needs the command's rule."""
    answer = field.rogue("shutdown", "/killer", "die", uri=outer(field, "/voice"))
    field.denied(answer, "shutdown", rule="[Commands] shutdown", resource="shutdown")


def test_stopping_the_master(field: Field) -> None:
    """`shutdown` of the master is granted to nobody by `default`."""
    answer = field.rogue("shutdown", "/killer", "die")
    field.denied(answer, "shutdownMaster", resource="shutdownMaster")


def test_topic_without_the_right(field: Field) -> None:
    """`requestTopic` on a node's face is decided like a subscription; no port is told."""
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
    """Only TCPROS is carried; who offers something else, or no protocols, is told so as by rospy, and gets nothing."""
    answer = field.rogue("requestTopic", "/udp", "/shared/talk", protocols, uri=outer(field, "/shared_voice"))
    assert (answer[0], answer[2]) == (code, [])
    assert words in answer[1]


def test_topic_that_the_node_does_not_publish(field: Field) -> None:
    """A right to a topic is no right to a node: it must publish it."""
    answer = field.rogue("requestTopic", "/asker", "/shared/other", TCPROS, uri=outer(field, "/voice"))
    assert (answer[0], answer[2]) == (-1, []), "as rospy says it"


# --- the relay's ports ---


def relay_port(field: Field) -> int:
    """The relay port of `/shared_voice`, with a grant for `/taker`."""
    code, _text, protocol = field.rogue(
        "requestTopic", "/taker", "/shared/talk", TCPROS, uri=outer(field, "/shared_voice")
    )
    assert code == 1
    return int(protocol[2])


def knock(field: Field, port: int, data: bytes) -> bytes:
    """What the relay answers a connection header; it ends when the relay closes, or with the first bytes."""
    with field.connect(port=port) as sock:
        sock.sendall(data)
        with contextlib.suppress(ConnectionResetError):
            return sock.recv(65536)
        return b""


STRING = {"type": "std_msgs/String", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1"}


def test_granted_topic_arrives(field: Field) -> None:
    """The tests below fail for the right reason: with the grant, the same connection is served."""
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
    """Who knows a relay port gets from it what was granted to his host and name, and nothing else."""
    answer = knock(field, relay_port(field), header(**fields, **STRING))
    assert b"callerid=/shared_voice" not in answer
    assert b"hello" not in answer
    field.recorded(event="connection refused", host="10.77.0.66")


def test_relay_port_of_a_node_nobody_asked_for(field: Field) -> None:
    """Guessing the relay port of the victim's node does not help either: it has no grant for this host."""
    uri = outer(field, "/voice")
    port = int(uri.rsplit(":", 1)[1].rstrip("/")) + 1  # two ports each
    answer = knock(field, port, header(callerid="/ear", topic="/chatter", **STRING))
    assert b"hello" not in answer
    assert b"callerid=/voice" not in answer


def test_grant_of_another_host(field: Field) -> None:
    """A grant is the host's that asked: with the same name from another host it is worth nothing."""
    uri = field.call(field.ocu, "lookupNode", "/looker2", "/voice")[2]
    code, _text, protocol = field.call(field.ocu, "requestTopic", "/borrowed", "/chatter", TCPROS, uri=uri)
    assert code == 1
    answer = knock(field, protocol[2], header(callerid="/borrowed", topic="/chatter", **STRING))
    assert b"hello" not in answer
    assert b"callerid=/voice" not in answer
    record = field.recorded(event="connection refused", host="10.77.0.66", caller_id="/borrowed")
    why = field.appliance.rosrv("audit", "why", record["id"]).stdout.splitlines()
    assert any(line.startswith("would be allowed by: /chatter = ") for line in why), why


# --- who must not be seen ---


def test_host_that_no_rule_names(field: Field) -> None:
    """A stranger gets a fault that says so, and is recorded with what he asked for."""
    answer = field.call(field.stranger, "getPid", "/stranger")
    assert "no rule of the policy names 10.77.0.99" in answer.faultString
    record = field.recorded(host="10.77.0.99", decision="deny", resource="getPid", caller_id="/stranger")
    assert record["detail"] == {"call": "getPid", "stranger": True}
    field.call(field.stranger, "registerPublisher", "/evil", "/shared/x", "std_msgs/String", field.api)
    field.recorded(host="10.77.0.99", category="publish", resource="/shared/x", caller_id="/evil")
    wider = field.home / "wider.ini"
    wider.write_text("[Publishers]\n/shared/x = 10.77.0.99\n[Nodes]\ndefault = *\n")
    differs = field.appliance.rosrv(
        "policy", "diff", str(field.appliance.policy_file), str(wider), check=False
    ).stdout
    assert any("/shared/x" in line and "10.77.0.99" in line for line in differs.splitlines()), differs
    face = outer(field, "/voice")
    answer = field.call(field.stranger, "getPid", "/stranger", uri=face)
    assert "no rule of the policy names 10.77.0.99" in answer.faultString


def test_port_scan(field: Field) -> None:
    """From outside nothing answers but RVMaster, the nodes' faces and the relay's ports."""
    hidden = {port for address, port in field.middle.run(_listening) if address == LOOPBACK}
    assert hidden, "the hidden ROSMaster and the inner faces listen somewhere"
    scanned = field.attacker.run(lambda: scan("10.77.0.2", range(1, 65536), 0.3))
    open_ports = set(scanned.open)
    assert 11311 in open_ports
    assert {port for port in open_ports if not 19001 <= port <= 26000} == {11311}
    assert not open_ports & hidden


def _listening() -> set[tuple[str, int]]:
    """(address, port) of all listening sockets of this namespace, as /proc writes them."""
    table = Path("/proc/thread-self/net/tcp").read_text(encoding="ascii")
    rows = [line.split() for line in table.splitlines()[1:]]
    return {(row[1].split(":")[0], int(row[1].split(":")[1], 16)) for row in rows if row[3] == "0A"}


def test_inner_face_and_own_listener_from_outside(field: Field) -> None:
    """What listens for ROSMaster and the appliance's own nodes is on loopback: nobody else gets there."""
    hidden = {port for address, port in field.middle.run(_listening) if address == LOOPBACK}
    for port in hidden:
        with pytest.raises(OSError, match=r"timed out|refused|unreachable"):
            field.attacker.run(partial(socket.create_connection, ("10.77.0.2", port), 0.5))


# --- peers that lie ---


def silent(_connection: socket.socket, _request: bytes) -> None:
    """Never answers."""
    threading.Event().wait(60)


def endless(connection: socket.socket, _request: bytes) -> None:
    """Two gigabytes."""
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: 2147483648\r\n\r\n")
    for _ in range(2048):
        connection.sendall(b" " * (1 << 20))


def twice(connection: socket.socket, _request: bytes) -> None:
    """Two answers to one question."""
    connection.sendall(response([1, "", 1]) + response([1, "", 2]))


def rubbish(connection: socket.socket, _request: bytes) -> None:
    """No HTTP at all."""
    connection.sendall(b"\x00\xff" * 1000)


def redirect(connection: socket.socket, _request: bytes) -> None:
    """Sends the caller to a third machine."""
    connection.sendall(
        b"HTTP/1.1 302 Found\r\nLocation: http://10.77.0.99:4444/\r\nContent-Length: 0\r\n\r\n"
    )


def drip(connection: socket.socket, _request: bytes) -> None:
    """A byte now and then, for ever."""
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 100000\r\n\r\n")
    pause = threading.Event()
    for _ in range(600):
        connection.sendall(b" ")
        pause.wait(0.1)


def bomb(connection: socket.socket, _request: bytes) -> None:
    """XML with an entity that grows."""
    body = b'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]><methodResponse/>'
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % len(body) + body)


@pytest.mark.parametrize(
    "behave", [silent, endless, twice, rubbish, redirect, drip, bomb], ids=lambda one: one.__name__
)
def test_node_that_lies(field: Field, behave: Any) -> None:
    """A node of the rogue's that misbehaves when it is called costs only himself: who asks it gets a well-formed answer
    or, where it gives none, the end of the connection, as of a node that is not there."""
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
