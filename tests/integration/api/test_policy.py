"""Policies over REST: dry run, refusal, load, explanation, rollback, and survival of a restart."""

import json
import re
import threading
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xmlrpc.server import SimpleXMLRPCServer

import pytest

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.command import rosrv
from tests.support.nodes import RosSession, has_ros
from tests.support.requirements import needs
from tests.support.rest import Rest
from tests.support.waiting import eventually

WITHOUT_PUBLISHERS = OPEN_POLICY.replace("[Publishers]\ndefault = *\n", "[Publishers]\n/allowed = *\n")
API = "http://127.0.0.1:1/"
TRANSPORT = ("--api", "127.0.0.1:0", "--api-tls", "off")


@pytest.fixture(scope="module")
def common_appliance() -> Iterator[Appliance]:
    """Run an appliance with REST in clear text."""
    with Appliance(options=TRANSPORT) as running:
        yield running


@pytest.fixture(scope="module")
def running(common_appliance: Appliance) -> Appliance:
    """Provide the appliance for tests that change nothing."""
    return common_appliance


@pytest.fixture
def appliance(common_appliance: Appliance) -> Iterator[Appliance]:
    """Provide the appliance with the open policy in force and only this test's log; the test may change the policy."""
    common_appliance.ignore_earlier_records()
    yield common_appliance
    cases_of(common_appliance).unlink(missing_ok=True)
    common_appliance.reload(OPEN_POLICY)
    with xmlrpc.client.ServerProxy(common_appliance.master_uri) as master:
        master.unregisterPublisher("/tester", "/cmd_vel", API)


def cases_of(appliance: Appliance) -> Path:
    """Return the path of the tests beside the policy."""
    return Path(f"{appliance.policy_file}.tests.yaml")


def in_force(rest: Rest) -> int:
    """Return the revision of the policy."""
    return int(rest.get("/v1/policy").json["revision"])


def tag(revision: int) -> str:
    """Return the ETag for If-Match."""
    return f'"{revision}"'


@pytest.fixture
def living_node() -> Iterator[int]:
    """Return the port of a node API that answers every call."""

    class Node:
        """Answers every call."""

        def _dispatch(self, _method: str, _params: tuple[Any, ...]) -> list[Any]:
            return [1, "", 0]

    with SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False, allow_none=True) as server:
        server.register_instance(Node())
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server.server_address[1]
        server.shutdown()
        thread.join()


def register(uri: str, topic: str) -> Any:
    """Register a publisher at RVMaster, and return the answer."""
    with xmlrpc.client.ServerProxy(uri) as master:
        return master.registerPublisher("/tester", topic, "std_msgs/String", API)


def call_with(appliance: Appliance, status: int) -> dict[str, Any] | None:
    """Return the record of a call of /v1/policy that ended with this status, once there is one."""
    calls = appliance.audit("--event", "rest call", resource="/v1/policy")
    return next((one for one in calls if one["detail"]["status"] == status), None)


def test_an_invalid_policy_is_rejected_with_every_finding(appliance: Appliance) -> None:
    """Each finding has line and column, the problem those of the first finding.

    Nothing changes; the refusal is recorded.
    """
    rest = appliance.rest()
    first = in_force(rest)
    answer = rest.post("/v1/policy", "[Nodes]\ndefault = *\nbogus\n[Publishrs]\n", match=tag(first))
    assert answer.status == 422
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json
    assert (problem["line"], problem["column"]) == (3, 1)
    assert [(one["line"], one["severity"]) for one in problem["findings"]] == [(3, "error"), (4, "error")]
    assert "did you mean Publishers?" in problem["findings"][1]["text"]
    assert in_force(rest) == first
    refused = eventually(lambda: call_with(appliance, 422), "the refused call is recorded")
    assert refused["detail"]["who"] == "first"
    assert "policy:3:1" in refused["reason"]
    assert refused["decision"] == "deny"
    [recorded] = appliance.recorded("--event", "policy refused")
    assert recorded["detail"]["who"] == "first"
    assert f"revision {first + 1}:3:1" in recorded["detail"]["findings"][0]


def loaded_last_by(appliance: Appliance) -> list[str]:
    """Return the user who loaded the latest policy in the log."""
    newest = appliance.audit("--event", "policy loaded", "--limit", "1")
    return [record["detail"]["who"] for record in newest]


@pytest.mark.real
def test_a_valid_policy_is_in_force_at_once_and_survives(appliance: Appliance) -> None:
    """The policy denies from the answer on; its revision has the author; a restart keeps it."""
    rest = appliance.rest()
    first = in_force(rest)
    assert register(appliance.master_uri, "/cmd_vel")[0] == 1
    posted = rest.post("/v1/policy", {"text": WITHOUT_PUBLISHERS, "note": "no publishers"}, match=tag(first))
    assert posted.status == 200
    assert posted.json | {"changes": [], "warnings": [], "ends": []} == {
        "loaded": True, "revision": first + 1, "replaced": first, "revoked": 1, "confirm_by": None, "warnings": [],
        "changes": [], "ends": [],
    }  # fmt: skip
    assert [(one["what"], one["resource"]) for one in posted.json["ends"]] == [("publication", "/cmd_vel")]
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


def test_a_dry_run_reports_changes_and_makes_none(appliance: Appliance) -> None:
    """Registrations that would be revoked are listed with the new policy's reason; no If-Match is needed."""
    rest = appliance.rest()
    first = in_force(rest)
    assert register(appliance.master_uri, "/cmd_vel")[0] == 1
    answer = rest.post("/v1/policy?dry_run=1", WITHOUT_PUBLISHERS)
    assert answer.status == 200
    report = answer.json
    assert (report["loaded"], report["revision"], report["revoked"]) == (False, first, None)
    (change,) = report["changes"]
    assert (change["resource"], change["now"], change["then"]) == ("/cmd_vel", "allow", "deny")
    assert "/cmd_vel" in change["reason"]
    assert register(appliance.master_uri, "/cmd_vel")[0] == 1
    assert in_force(rest) == first


def test_a_dry_run_lists_every_revoked_registration(
    appliance: Appliance, living_node: int, tmp_path: Path
) -> None:
    """Publications, subscriptions, services, calls and parameters are listed, both over REST and by command."""
    node = f"http://127.0.0.1:{living_node}/"
    with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
        answers = [
            master.registerPublisher("/driver", "/scan", "std_msgs/String", node),
            master.registerSubscriber("/driver", "/cmd_vel", "std_msgs/String", node),
            master.registerService("/driver", "/reset", "rosrpc://127.0.0.1:2", node),
            master.subscribeParam("/driver", node, "/limits/speed"),
            master.lookupService("/ui", "/reset"),
        ]
    assert [one[0] for one in answers] == [1] * 5  # type: ignore[index]  # what a master answers
    nothing = "[Nodes]\n/other = *\n[Commands]\nshutdown = robot\n[Services]\n[Clients]\n[Parameters]\n"
    rest = appliance.rest()
    first = in_force(rest)
    ends = rest.post("/v1/policy?dry_run=1", nothing).json["ends"]
    expected = {
        ("publication", "/scan", "/driver"), ("subscription", "/cmd_vel", "/driver"),
        ("service", "/reset", "/driver"), ("parameter", "/limits/speed", "/driver"),
        ("call", "/reset", "/ui"),
    }  # fmt: skip
    assert {(one["what"], one["resource"], one["caller_id"]) for one in ends} == expected
    file = tmp_path / "nothing.ini"
    file.write_text(nothing)
    by_socket = appliance.rosrv("policy", "check", str(file))
    assert f"{len(ends)} live connections would end" in by_socket.stdout
    assert "\n  subscription /cmd_vel of /driver: " in by_socket.stdout
    told = appliance.rosrv("policy", "check", str(file), "--json").stdout.splitlines()
    assert sum("ends" in json.loads(one) for one in told) == len(ends)
    place = ("--api", str(appliance.ready["api"]))
    by_rest = rosrv("policy", "check", str(file), *place, ROSRV_TOKEN=appliance.token)
    assert by_rest.returncode == 0, by_rest.stderr
    assert (
        sorted(by_rest.stdout.splitlines())[-len(ends) :]
        == sorted(by_socket.stdout.splitlines())[-len(ends) :]
    )
    assert in_force(rest) == first
    assert rest.post("/v1/policy?dry_run=1", OPEN_POLICY).json["ends"] == []


def test_check_asks_the_appliance_for_enrolled_hosts(appliance: Appliance, tmp_path: Path) -> None:
    """A policy that names only the robot is valid without `--robot`; without the appliance the check says so."""
    file = tmp_path / "p.ini"
    file.write_text("[Nodes]\ndefault = host:laptop\n[Commands]\ndefault = robot\n")
    assert 'no host "laptop" is enrolled' in appliance.rosrv("policy", "check", str(file)).stdout
    given = appliance.rosrv("policy", "check", str(file), "--enrolled", "laptop=10.0.0.9").stdout
    assert "is enrolled" not in given
    stopped = rosrv("policy", "check", str(file), "--state", str(tmp_path))
    assert (stopped.returncode, "checked without it" in stopped.stderr) == (0, True)


def test_the_tests_beside_the_file_guard_it(appliance: Appliance) -> None:
    """A text that fails FILE.tests.yaml is refused with the position of the case, also as a dry run."""
    cases = cases_of(appliance)
    cases.write_text("cases:\n  - host: 10.0.0.9\n    node: /joy\n    allow: [publish /cmd_vel]\n")
    rest = appliance.rest()
    present = tag(in_force(rest))
    for path, match in (("/v1/policy?dry_run=1", None), ("/v1/policy", present)):
        answer = rest.post(path, WITHOUT_PUBLISHERS, match=match)
        assert answer.status == 422
        (finding,) = answer.json["findings"]
        assert (finding["file"], finding["line"]) == (str(cases), 4)
        assert "expected allow" in finding["text"]
    assert rest.post("/v1/policy", OPEN_POLICY, match=present).status == 200


@pytest.mark.real
def test_a_change_is_recorded_before_it_is_answered(appliance: Appliance) -> None:
    """A search right after a change finds its record."""
    newest = ("--event", "policy loaded", "--limit", "1")
    for _ in range(20):
        loaded = json.loads(appliance.rosrv("policy", "reload", "--json").stdout)
        assert [record["revision"] for record in appliance.audit(*newest)] == [loaded["revision"]]


@pytest.mark.real
def test_reload_replaces_the_policy_by_the_file(appliance: Appliance) -> None:
    """The file replaces the policy loaded over REST, as the answer reports; the file's revision is in force again."""
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


def test_explain_returns_the_same_as_the_command(running: Appliance, rest: Rest) -> None:
    """REST and the command explain with the same reason, for the policy in force and for a draft."""
    running.policy_file.write_text(OPEN_POLICY)
    question = "host=10.0.0.9&category=publish&resource=/cmd_vel&node=/joy"
    answer = rest.get(f"/v1/policy/explain?{question}").json
    assert answer["allowed"] is True
    assert answer["rule"]["section"] == "Publishers"
    assert answer["node"]["decision"] == "allow"
    draft = {"host": "10.0.0.9", "category": "publish", "resource": "/cmd_vel", "node": "/joy"}
    under = rest.post("/v1/policy/explain", draft | {"text": WITHOUT_PUBLISHERS}).json
    assert under["allowed"] is False
    told = running.rosrv(
        "policy", "explain", str(running.policy_file), "--host", "10.0.0.9", "--node", "/joy", "--publish", "/cmd_vel",
        "--json", state=False,
    ).stdout  # fmt: skip
    assert json.loads(told)["through"] == answer["through"]
    for bad in (
        "host=nobody&category=publish&resource=/a&node=/b",
        "host=robot&category=publish&resource=/a",
    ):
        assert rest.get(f"/v1/policy/explain?{bad}").status == 422


def reported(rest: Rest) -> dict[str, Any] | None:
    """Return the topic /chatter in the graph after the relay has reported its rate, which it does once a second."""
    topic: dict[str, Any] = next(
        one for one in rest.get("/v1/graph").json["topics"] if one["name"] == "/chatter"
    )
    return topic if topic["publishers"][0]["messages_per_second"] > 1 else None


def measured(rest: Rest) -> str | None:
    """Return the metrics after they include the delay of a message on /chatter."""
    metrics = rest.get("/metrics").body.decode()
    counted = re.search(r'rosrv_relay_delay_seconds_count\{resource="/chatter"\} [1-9]', metrics)
    return metrics if counted else None


def test_the_graph_shows_nodes_topics_and_connections(appliance: Appliance, tmp_path: Path) -> None:
    """With two real nodes the graph has both, the mediated topic, the connection and the rate."""
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
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
