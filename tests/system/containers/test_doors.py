"""Doors in Docker as docs/doors.md describes: a ticket on this machine, agents in a container and on this machine."""

import json
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from tests.support.docker import APPLIANCE, ROOT, Compose, Output, project
from tests.support.waiting import eventually
from tests.system.containers.conftest import Site

pytestmark = pytest.mark.timeout(1500)  # for the first test: the images are built

SECONDS = 30.0
BATTERY, GPS = "/landshark/battery", "/landshark/gps"
RULE = "(containers.ini:"
AGENT = "ws://127.0.0.1:9091"
# What an agent in a container gets, a line for each topic.
PROGRAM = """
import json, sys
from websockets.sync.client import connect
with connect("ws://appliance:9092", open_timeout=20) as client:
    for topic in sys.argv[1:]:
        client.send(json.dumps({"op": "subscribe", "topic": topic, "id": topic}))
        print(client.recv(30))
        client.send(json.dumps({"op": "unsubscribe", "topic": topic, "id": topic}))
"""


def with_doors(policy: str) -> str:
    given = {
        "[Nodes]\n": "viewers = door:alice door:agent-1 door:agent-2\n\n[Nodes]\n/door_* = viewers\n",
        f"{BATTERY}    = vehicle ocu tablet": f"{BATTERY} = vehicle ocu tablet viewers",
    }
    for before, after in given.items():
        assert policy.count(before) == 1
        policy = policy.replace(before, after)
    return policy


def documented_override() -> str:
    page = (ROOT / "docs" / "doors.md").read_text()
    return page.partition("```yaml\n")[2].partition("```")[0]


@pytest.fixture(scope="module")
def doors(site: Site, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Compose]:
    folder: Path = project(tmp_path_factory.mktemp("project"))
    policy = folder / "policies" / "containers.ini"
    policy.write_text(with_doors(policy.read_text()))
    (folder / "compose.override.yaml").write_text(documented_override())
    compose = site.engine.compose(folder, "doors")
    try:
        compose("--profile", "demo", "up", "--detach", "--no-build", "landshark")
        compose.wait_healthy()
        rosrv(compose, "door", "add", "alice")
        rosrv(compose, "door", "add", "agent-1", "--port", "9091", "--from", "172.29.76.1")
        rosrv(compose, "door", "add", "agent-2", "--port", "9092", "--from", "172.29.78.30")
        serve(compose)
        yield compose
    finally:
        compose("--profile", "demo", "down", "--volumes", "--timeout", "5")


def rosrv(compose: Compose, *arguments: str) -> str:
    return compose.exec("appliance", "rosrv", *arguments).stdout


def rows(compose: Compose) -> list[dict[str, Any]]:
    return [json.loads(line) for line in rosrv(compose, "door", "list", "--json").splitlines()]


def serve(compose: Compose) -> None:
    eventually(lambda: not any(row["trouble"] for row in rows(compose)), compose.story)


def ticket(compose: Compose) -> str:
    return rosrv(compose, "door", "ticket", "alice").strip().replace("ADDRESS", "127.0.0.1")


def opened(url: str, origin: str | None = None) -> ClientConnection:
    trusting = ssl.create_default_context()
    trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE
    return connect(
        url,
        ssl=trusting if url.startswith("wss:") else None,
        origin=None if origin is None else Origin(origin),
        open_timeout=SECONDS,
    )


def answer(client: ClientConnection, topic: str) -> Any:
    client.send(json.dumps({"op": "subscribe", "topic": topic, "id": topic}))
    frame = json.loads(client.recv(SECONDS))
    client.send(json.dumps({"op": "unsubscribe", "topic": topic, "id": topic}))
    return frame


def sees_the_battery_only(battery: Any, gps: Any) -> None:
    assert (battery["op"], battery["topic"]) == ("publish", BATTERY)
    assert 0 < battery["msg"]["percentage"] <= 1
    assert (gps["op"], gps["level"], gps["id"]) == ("status", "error", GPS)
    assert RULE in gps["msg"] and GPS in gps["msg"]


def test_a_ticket_opens_the_door_on_this_machine(site: Site, doors: Compose) -> None:
    url = ticket(doors)

    def work() -> None:
        with opened(url, "https://127.0.0.1:8443") as client:
            sees_the_battery_only(answer(client, BATTERY), answer(client, GPS))
        with pytest.raises(InvalidStatus) as error, opened(url, "https://elsewhere.example"):
            pass
        assert error.value.response.status_code == 403

    site.machine.run(work)
    [alice] = [row for row in rows(doors) if row["name"] == "alice"]
    denied = eventually(lambda: doors.audit("--deny", "--host", alice["address"]), doors.story)
    assert {record["resource"] for record in denied} == {GPS}


def test_an_agent_on_this_machine_has_the_rights_of_its_port(site: Site, doors: Compose) -> None:
    def work() -> None:
        with opened(AGENT) as client:
            sees_the_battery_only(answer(client, BATTERY), answer(client, GPS))

    site.machine.run(work)


def in_container(site: Site, doors: Compose, address: str, *topics: str) -> Output:
    network = ("--network", f"{doors.project}_operators", "--ip", address)
    program = ("--entrypoint", "python", APPLIANCE, "-c", PROGRAM, *topics)
    return site.engine.docker("run", "--rm", *network, *program, check=False)


def test_an_agent_in_a_container_needs_no_published_port(site: Site, doors: Compose) -> None:
    done = in_container(site, doors, "172.29.78.30", BATTERY, GPS)
    assert done.returncode == 0, done.stderr
    sees_the_battery_only(*map(json.loads, done.stdout.splitlines()))
    other = in_container(site, doors, "172.29.78.31", BATTERY)
    assert other.returncode != 0 and not other.stdout

    def recorded() -> bool:
        refused = doors.audit(event="door entry refused", resource="agent-2")
        return any("the agent's address is 172.29.78.30" in record["reason"] for record in refused)

    eventually(recorded, doors.story)
