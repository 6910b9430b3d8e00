"""Examples of the contract: the appliance accepts the example bodies, and its answers have the form of the examples.

tests/unit/api/test_contract.py checks that each example fits its schema and that no example is missing.
"""

import json
import tempfile
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.api.contract import EXAMPLES
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.rest import Rest

CONFIGURATION = """
audit: {checkpoint_seconds: 1, reserve_bytes: 1MiB}
recorder: {enabled: true, memory: 16MiB, disk: 512MiB, triggers: []}
"""
CLOSED = OPEN_POLICY.replace("[Publishers]\n", "[Publishers]\n/cmd_vel = 192.0.2.10\n")


@pytest.fixture(scope="module")
def rest() -> Iterator[Rest]:
    """Run REST of an appliance with the monitor of the examples, and cause the denials that they show."""
    with tempfile.TemporaryDirectory(prefix="rosrv-examples-") as name:
        folder = Path(name)
        folder.chmod(0o755)  # the appliance's processes run as other users
        (folder / "monitors").mkdir()
        (folder / "monitors/censor.rv").write_text(EXAMPLES["Monitor"]["text"])
        (folder / "appliance.yaml").write_text(CONFIGURATION)
        options = ("--config", str(folder / "appliance.yaml"), "--monitors", str(folder / "monitors"))
        with Appliance(policy=CLOSED, options=(*options, "--api", "127.0.0.1:0")) as running:
            with xmlrpc.client.ServerProxy(running.master_uri) as master:
                answer = master.registerPublisher(
                    "/joy", "/cmd_vel", "geometry_msgs/Twist", "http://127.0.0.1:1/"
                )
                assert isinstance(answer, list)
                assert answer[0] != 1
            yield running.rest()


def asked(rest: Rest, call: str, body: Any = None) -> Any:
    """Return the answer to a call; a body is JSON."""
    method, path = call.split()
    headers = {"If-Match": "*"} if method != "GET" else {}
    if body is not None:
        headers["Content-Type"] = "application/json"
    answer = rest.request(method, path, None if body is None else json.dumps(body).encode(), headers)
    assert answer.status in (200, 201), (call, answer.body)
    return answer.json


def differences(given: Any, shown: Any, place: str, *, whole: bool = True) -> list[str]:
    """Return the places where an answer differs from the form of an example; extra fields may appear below them."""
    if isinstance(given, dict) and isinstance(shown, dict):
        nowhen = {f"{name}_utc" for one in (given, shown) for name, value in one.items() if value is None}
        found = [f"{place}: {name}" for name in (given.keys() ^ shown.keys()) - nowhen if whole]
        for name in given.keys() & shown.keys():
            found += differences(given[name], shown[name], f"{place}.{name}", whole=False)
        return found
    if isinstance(given, list) and isinstance(shown, list):
        pairs = zip(given, shown, strict=False)
        return [line for pair in pairs for line in differences(*pair, f"{place}[]", whole=False)]
    numbers = isinstance(given, int | float) and isinstance(shown, int | float)
    alike = numbers or given is None or shown is None or type(given) is type(shown)
    return [] if alike else [f"{place}: {given!r}, not as {shown!r}"]


CALLS = {
    "GET /healthz": "Health", "GET /v1/status": "Status", "GET /v1/inventory": "Inventory", "GET /v1/graph": "Graph",
    "GET /v1/history?points=2": "Hour", "GET /v1/whoami": "Holder", "GET /v1/challenge": "Challenge",
    "GET /v1/tokens": "Tokens", "GET /v1/hosts": "Hosts", "POST /v1/hosts/reload": "Reloaded",
    "GET /v1/policy": "PolicyInForce", "GET /v1/policy/revisions": "PolicyRevisionList",
    "GET /v1/policy/revisions/1": "RevisionText", "POST /v1/policy/reload": "Loaded",
    "POST /v1/policy/confirm": "PolicyConfirmed", "GET /v1/monitors": "Monitors",
    "GET /v1/monitors/censor": "Monitor", "GET /v1/monitors/censor/history": "History",
    "GET /v1/monitors/revisions": "MonitorRevisionList", "GET /v1/monitors/revisions/1": "RevisionTexts",
    "POST /v1/monitors/reload": "Replaced", "POST /v1/monitors/confirm": "MonitorsConfirmed",
    "GET /v1/audit?deny=1&topic=/cmd_vel": "search_audit", "GET /v1/audit/verify": "Verification",
    "GET /v1/audit/summary": "DenialSummary", "GET /v1/audit/checkpoints": "LogCheckpoints",
    "GET /v1/recordings": "Recordings",
}  # fmt: skip
# The examples of bodies are sent unchanged, in this order.
BODIES = (
    ("POST /v1/policy?dry_run=1", "PolicyText", "Report"),
    ("POST /v1/policy/explain", "Question", "Explained"),
    ("POST /v1/policy/test", "Draft", "Tested"),
    ("POST /v1/policy?confirm_within=300", "PolicyText", "Report"),
    ("POST /v1/policy/rollback", "Rollback", "Loaded"),
    ("POST /v1/monitors?dry_run=1", "NewSpecifications", "Replaced"),
    ("POST /v1/monitors", "NewSpecifications", "Replaced"),
    ("PUT /v1/monitors/censor", "NewText", "Replaced"),
    ("PATCH /v1/monitors/censor", "Switch", "Switched"),
    ("PATCH /v1/monitors", "SwitchMany", "Switched"),
    ("POST /v1/monitors/rollback", "Rollback", "Replaced"),
    ("POST /v1/recordings", "NewRecording", "RecordingBegun"),
)


def test_answers_are_as_the_contract_shows_them(rest: Rest) -> None:
    """Answers that need no nodes and no tunnels have the fields and types of the contract."""
    found = [
        line for call, kind in CALLS.items() for line in differences(asked(rest, call), EXAMPLES[kind], call)
    ]
    refusal = asked(rest, "GET /v1/audit?deny=1&topic=/cmd_vel")["records"][0]["sequence"]
    for call, name in (
        (f"GET /v1/audit/{refusal}", "audit_record"),
        (f"GET /v1/audit/{refusal}/grant", "Granted"),
        (f"GET /v1/audit/{refusal}/why", "Why"),
    ):
        found += differences(asked(rest, call), EXAMPLES[name], call)
    assert found == []


def test_the_bodies_of_the_contract_are_accepted(rest: Rest) -> None:
    """Each body is sent as in the contract, and its answer is as in the contract."""
    found = [
        line
        for call, body, kind in BODIES
        for line in differences(asked(rest, call, EXAMPLES[body]), EXAMPLES[kind], call)
    ]
    assert found == []


def test_a_difference_would_be_found() -> None:
    """A wrong example would make the tests above fail."""
    shown = {"a": 1, "b": [{"c": "x"}]}
    assert differences({"a": 2.0, "b": [{"c": None}]}, shown, "") == []
    assert sorted(differences({"a": "1", "b": [{"c": 1}]}, shown, "")) == [
        ".a: '1', not as 1",
        ".b[].c: 1, not as 'x'",
    ]
    assert differences({"a": 1}, shown, "") == [": b"]
