import json
import re
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.nodes import RosSession, need_ros
from tests.support.rest import Rest
from tests.support.waiting import eventually

WITHOUT_PUBLISHERS = OPEN_POLICY.replace("[Publishers]\ndefault = *\n", "[Publishers]\n/allowed = *\n")
API = "http://127.0.0.1:1/"
TRANSPORT = ("--api", "127.0.0.1:0", "--api-tls", "off")


@pytest.fixture(scope="module")
def common_appliance() -> Iterator[Appliance]:
    with Appliance(options=TRANSPORT) as running:
        yield running


@pytest.fixture
def appliance(common_appliance: Appliance) -> Iterator[Appliance]:
    common_appliance.ignore_earlier_records()
    yield common_appliance
    common_appliance.reload(OPEN_POLICY)
    with xmlrpc.client.ServerProxy(common_appliance.master_uri) as master:
        master.unregisterPublisher("/tester", "/cmd_vel", API)


def in_force(rest: Rest) -> int:
    return int(rest.get("/v1/policy").json["revision"])


def tag(revision: int) -> str:
    return f'"{revision}"'


def register(uri: str, topic: str) -> Any:
    with xmlrpc.client.ServerProxy(uri) as master:
        return master.registerPublisher("/tester", topic, "std_msgs/String", API)


def loaded_last_by(appliance: Appliance) -> list[str]:
    newest = appliance.audit("--event", "policy loaded", "--limit", "1")
    return [record["detail"]["who"] for record in newest]


@pytest.mark.real
def test_a_valid_policy_is_in_force_at_once_and_survives(appliance: Appliance) -> None:
    rest = appliance.rest()
    first = in_force(rest)
    assert register(appliance.master_uri, "/cmd_vel")[0] == 1
    posted = rest.post("/v1/policy", {"text": WITHOUT_PUBLISHERS, "note": "no publishers"}, match=tag(first))
    assert posted.status == 200
    assert posted.json | {"changes": [], "warnings": [], "ends": []} == {
        "loaded": True, "revision": first + 1, "replaced": first, "revoked": 1, "confirm_by": None, "warnings": [],
        "changes": [], "ends": [],
    }  # fmt: skip
    assert [(end["what"], end["resource"]) for end in posted.json["ends"]] == [("publication", "/cmd_vel")]
    assert posted.etag == tag(first + 1)
    assert register(appliance.master_uri, "/cmd_vel")[0] == 0
    assert loaded_last_by(appliance) == ["first"]
    status = appliance.status()["policy"]
    assert (status["revision"], status["differs_from_file"], status["who"]) == (first + 1, True, "first")
    assert "loaded by first" in " ".join(appliance.rosrv("status", check=False).stdout.split())
    appliance.stop()
    appliance.start()
    assert appliance.ready["revision"] == first + 1
    assert register(appliance.master_uri, "/cmd_vel")[0] == 0


@pytest.mark.real
def test_a_change_is_recorded_before_it_is_answered(appliance: Appliance) -> None:
    newest = ("--event", "policy loaded", "--limit", "1")
    for number in range(20):
        appliance.policy_file.write_text(f"{OPEN_POLICY}# {number}\n")
        loaded = json.loads(appliance.rosrv("policy", "reload", "--json").stdout)
        assert [record["revision"] for record in appliance.audit(*newest)] == [loaded["revision"]]


@pytest.mark.real
def test_reload_replaces_the_policy_by_the_file(appliance: Appliance) -> None:
    rest = appliance.rest()
    first = in_force(rest)
    rest.post("/v1/policy", WITHOUT_PUBLISHERS, match=tag(first))
    answer = rest.post("/v1/policy/reload", match=tag(first + 1))
    assert (answer.json["revision"], answer.json["replaced"]) == (first + 2, first + 1)
    assert rest.get("/v1/policy").json["differs_from_file"] is False
    assert rest.get("/v1/policy").json["who"] == "disk"
    assert loaded_last_by(appliance) == ["first"]
    appliance.policy_file.write_text("[Nodes]\nnonsense\n")
    refused = rest.post("/v1/policy/reload", match=tag(first + 2))
    assert refused.status == 422
    assert f"{appliance.policy_file}:2:1" in refused.json["detail"]


def reported(rest: Rest) -> dict[str, Any] | None:
    """Return the topic once the relay has reported its rate, which it does every second."""
    topic: dict[str, Any] = next(
        one for one in rest.get("/v1/graph").json["topics"] if one["name"] == "/chatter"
    )
    return topic if topic["publishers"][0]["messages_per_second"] > 1 else None


def measured(rest: Rest) -> str | None:
    metrics = rest.get("/metrics").body.decode()
    counted = re.search(r'rosrv_relay_delay_seconds_count\{resource="/chatter"\} [1-9]', metrics)
    return metrics if counted else None


def test_the_graph_shows_nodes_topics_and_connections(appliance: Appliance, tmp_path: Path) -> None:
    need_ros()
    rest = appliance.rest()
    with RosSession(appliance.master_uri, tmp_path) as ros:
        ros.talker("rospy", "/chatter", name="talker")
        listener = ros.listener("rospy", "/chatter", name="listener")
        listener.wait_for(event="received")
        topic = eventually(lambda: reported(rest), "the relay's report of the topic")
        metrics = eventually(lambda: measured(rest), "the relay's report of delays")
    assert topic["type"] == "std_msgs/String"
    assert topic["mediated"] is True
    assert topic["subscribers"] == ["/listener"]
    assert topic["connections"] == [{"from": "/talker", "to": "/listener", "host": "127.0.0.1"}]
    assert 1 < topic["publishers"][0]["messages_per_second"] < 50
    assert 'rosrv_relay_messages_total{resource="/chatter"}' in metrics
    assert 0 < topic["publishers"][0]["delay_seconds"] < 1
    assert 'rosrv_decisions_total{category="publish",outcome="allow"}' in metrics
