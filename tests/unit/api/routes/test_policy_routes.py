from collections.abc import Iterator
from typing import Any

import pytest

from appliance.channel import admin
from appliance.channel.answers.graph_answers import Registrations
from appliance.channel.answers.monitor_answers import Monitors
from appliance.channel.answers.policy_answers import PolicyKnown
from appliance.control.errors import PolicyRefusedError
from appliance.specifications.specification_files import SpecificationsRefusedError
from tests.support.answers import example
from tests.support.control_parts import OPEN
from tests.support.rest_world import RestWorld

NOTHING = "[Nodes]\n/other = *\n[Commands]\nshutdown = robot\n[Services]\n[Clients]\n[Parameters]\n"
WRONG = "[Nodes]\ndefault = *\nbogus\n[Publishrs]\n"
GRANTS = [
    ("registerPublisher", "/scan", "publication"), ("registerSubscriber", "/cmd_vel", "subscription"),
    ("registerService", "/reset", "service"), ("subscribeParam", "/limits/speed", "parameter"),
    ("lookupService", "/reset", "call"),
]  # fmt: skip
CASES = "cases:\n  - {host: 10.0.0.9, node: /joy, allow: [publish /cmd_vel]}\n"
SPEED = """speed() { event said(std::string text) /chatter std_msgs/String '{data:text}' { } ere: said said @fail { } }
count() { event said() /chatter std_msgs/String '{}' { } }
"""


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RestWorld]:
    api = RestWorld(tmp_path_factory.mktemp("state"))
    yield api
    api.close()


@pytest.fixture
def world(api: RestWorld) -> RestWorld:
    api.carried.error = None
    api.carried.answers |= {
        admin.PolicyWanted: example(
            PolicyKnown, revision=7, text=OPEN, file="p.ini", robot=["10.0.0.1"], cases=CASES,
            cases_file="p.ini.tests.yaml",
        ),
        admin.RegistrationsWanted: example(Registrations, registrations=[
            {"host": "10.0.0.5", "caller_id": "/n", "call": call, "resource": name} for call, name, _what in GRANTS
        ]),
        admin.MonitorsWanted: example(
            Monitors, revision=3, tag="3.1", files={"speed.rv": SPEED}, definitions={},
            monitors=[{"name": name, "file": "speed.rv", "enabled": True} for name in ("speed", "count")],
        ),
    }  # fmt: skip
    return api


def without_cases(world: RestWorld) -> None:
    answers = world.carried.answers
    answers[admin.PolicyWanted] = example(PolicyKnown, revision=7, text=OPEN, file="p.ini")


def test_a_dry_run_lists_everything_that_a_load_would_end(world: RestWorld) -> None:
    without_cases(world)
    report = world.asked("POST", "/v1/policy?dry_run=1", NOTHING).json()
    assert (report["loaded"], report["revision"], report["revoked"]) == (False, 7, None)
    assert {(end["what"], end["resource"]) for end in report["ends"]} == {
        (what, name) for _call, name, what in GRANTS
    }
    [change] = [one for one in report["changes"] if one["category"] == "publish"]
    assert (change["resource"], change["now"], change["then"]) == ("/scan", "allow", "deny")
    assert world.asked("POST", "/v1/policy?dry_run=1", OPEN).json()["ends"] == []


@pytest.mark.parametrize("target", ["/v1/policy?dry_run=1", "/v1/policy", "/v1/policy/test"])
def test_a_rejected_policy_has_every_finding(world: RestWorld, target: str) -> None:
    world.carried.error = PolicyRefusedError(["revision 8:3:1: error: bogus"])
    sent: Any = {"text": WRONG} if target.endswith("test") else WRONG
    problem = world.asked("POST", target, sent, tag='"7"').json()
    assert (problem["status"], problem["line"], problem["column"]) == (422, 3, 1)
    assert [(one["line"], one["severity"]) for one in problem["findings"]] == [(3, "error"), (4, "error")]
    assert "did you mean Publishers?" in problem["findings"][1]["text"]
    assert [type(one.request) for one in world.made] == [admin.PolicyLoad] * (target == "/v1/policy")
    [record] = world.trail.rows
    assert record["decision"] == ("deny" if target == "/v1/policy" else "allow"), "a draft changes nothing"


def test_the_tests_beside_the_file_guard_it(world: RestWorld) -> None:
    [finding] = world.asked("POST", "/v1/policy?dry_run=1", NOTHING).json()["findings"]
    assert (finding["file"], finding["line"]) == ("p.ini.tests.yaml", 2)
    assert "expected allow" in finding["text"]
    tested = world.asked("POST", "/v1/policy/test", {"text": NOTHING}).json()
    assert (tested["exists"], tested["passed"], tested["failed"], tested["cases"][0]["decision"]) == (
        True,
        0,
        1,
        "deny",
    )
    assert world.asked("POST", "/v1/policy/test", {}).json()["failed"] == 0


def test_a_request_is_explained_by_the_policy_in_force_or_by_a_draft(world: RestWorld) -> None:
    question = {"host": "10.0.0.9", "category": "publish", "resource": "/cmd_vel", "node": "/joy"}
    asked = "&".join(f"{name}={value}" for name, value in question.items())
    answer = world.asked("GET", f"/v1/policy/explain?{asked}").json()
    assert (answer["allowed"], answer["rule"]["section"], answer["node"]["decision"]) == (
        True,
        "Publishers",
        "allow",
    )
    assert not world.asked("POST", "/v1/policy/explain", question | {"text": NOTHING}).json()["allowed"]
    for wrong in ("host=nobody&node=/b", "host=robot"):
        answer = world.asked("GET", f"/v1/policy/explain?category=publish&resource=/a&{wrong}")
        assert answer.status_code == 422, wrong


def test_a_missing_log_is_a_problem(world: RestWorld) -> None:
    assert world.asked("GET", "/v1/audit/summary").json()["type"] == "urn:rosrv:problem:log-unreadable"


def test_one_monitor_is_shown_in_detail(world: RestWorld) -> None:
    shown = world.asked("GET", "/v1/monitors/speed")
    assert shown.headers["etag"] == '"3.1"'
    body = shown.json()
    assert (body["text"], body["revision"], body["enabled"]) == (SPEED, 3, True)
    assert [(one["name"], one["topic"]) for one in body["alphabet"]] == [("said", "/chatter")]
    assert [(one["logic"], one["drawn"]) for one in body["properties"]] == [("ere", True)]
    assert world.asked("GET", "/v1/monitors/speed/picture").text.startswith("<svg ")
    assert world.asked("GET", "/v1/monitors/count/picture").status_code == 404
    unknown = world.asked("GET", "/v1/monitors/nobody")
    assert (unknown.status_code, "there are: speed, count" in unknown.json()["detail"]) == (404, True)


@pytest.mark.parametrize(("method", "target"), [("POST", "/v1/monitors"), ("PUT", "/v1/monitors/speed")])
def test_a_rejected_specification_has_its_place(world: RestWorld, method: str, target: str) -> None:
    world.carried.error = SpecificationsRefusedError(["speed.rv:2:9: error: unknown type", "and more"])
    problem = world.asked(
        method, target, {"files": {"speed.rv": "x"}} if method == "POST" else "x", tag="*"
    ).json()
    assert (problem["type"], problem["line"], problem["column"]) == (
        "urn:rosrv:problem:specifications-refused",
        2,
        9,
    )
    assert [(one["file"], one["severity"]) for one in problem["findings"]] == [("speed.rv", "error")]


def test_a_dry_run_sends_the_order_and_carries_out_none(world: RestWorld) -> None:
    world.asked("PUT", "/v1/monitors/count?dry_run=1", "text")
    assert [one.order for one in world.sent(admin.MonitorTry)] == [admin.MonitorReplace("count", "text")]
    assert world.sent(admin.MonitorReplace) == []
