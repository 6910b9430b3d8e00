import json
import xmlrpc.client
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.appliance import Appliance
from tests.support.rest import Rest

POLICY = "[Nodes]\ndefault = *\n[Publishers]\n/allowed = *\n[Commands]\ndefault = *\n"


@pytest.fixture(scope="module")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    config = tmp_path_factory.mktemp("config") / "appliance.yaml"
    config.write_text("audit: {durability: strict, checkpoint_seconds: 2}\napi: 127.0.0.1:0\napi_tls: off\n")
    with Appliance(policy=POLICY, options=("--config", str(config))) as running:
        yield running


@pytest.fixture(scope="module")
def rest(appliance: Appliance) -> Rest:
    return appliance.rest()


def publish(appliance: Appliance, topic: str) -> Any:
    with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
        return master.registerPublisher("/tester", topic, "std_msgs/String", "http://127.0.0.1:1/")


def test_followers_get_a_denial_live(appliance: Appliance, rest: Rest) -> None:
    events = rest.events("/v1/audit/stream?decision=deny&category=publish")
    next(events)
    publish(appliance, "/allowed")
    publish(appliance, "/cmd_vel")
    event = next(events)
    record = json.loads(event["data"])
    assert (event["event"], event["id"]) == ("record", str(record["sequence"]))
    assert (record["decision"], record["resource"], record["caller_id"]) == ("deny", "/cmd_vel", "/tester")
    assert record["host"] == "127.0.0.1"


def test_a_reconnecting_client_misses_no_record(appliance: Appliance, rest: Rest) -> None:
    publish(appliance, "/first")
    first = rest.get("/v1/audit?resource=/first&event=decision").json["records"][0]
    publish(appliance, "/second")
    mine = "category=publish&event=decision&caller_id=/tester"
    for events in (
        rest.events(f"/v1/audit/stream?{mine}", Last_Event_ID=str(first["sequence"])),
        rest.events(f"/v1/audit/stream?{mine}&after={first['sequence']}"),
    ):
        next(events)
        assert json.loads(next(events)["data"])["resource"] == "/second"


@pytest.mark.real
def test_search_returns_the_same_as_the_command(appliance: Appliance, rest: Rest) -> None:
    publish(appliance, "/sought")
    found = rest.get("/v1/audit?resource=/sou*&decision=deny&since=1h").json["records"]
    assert found == appliance.audit("--topic", "/sou*", "--deny", "--since", "1h")
    assert found[0]["rule"] is None or found[0]["rule"]["section"] == "Publishers"
    assert rest.get("/v1/audit?resource=/nothing").json == {"records": [], "cursor": None}


@pytest.mark.real
def test_the_log_is_proven(rest: Rest) -> None:
    verified = rest.get("/v1/audit/verify").json
    assert verified["ok"] is True
    assert verified["records"] > 0
    assert verified["findings"] == []
