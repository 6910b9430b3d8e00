import asyncio
import json
from pathlib import Path
from typing import Any

import httpx
import pytest

import appliance.api.routes as examples
from appliance.api.app import build_app
from appliance.api.front.access import Bearer, TokenAuthenticator
from appliance.api.front.control import ControlLink
from appliance.api.front.history import SampleHistory, measures_of
from appliance.api.front.journal import Journal
from appliance.api.front.request_gate import RequestGate
from appliance.api.front.services import Services
from appliance.channel.admin import A, AdminAnswer, AdminRequest
from appliance.channel.messages.api import TokenKept
from appliance.configuration.settings import ApiLimits, Settings
from appliance.features.standby import requests as standby_requests
from appliance.features.standby.answers import StandbyState
from appliance.features.standby.orders import on_standby
from appliance.store.access_tokens import make_token
from tests.support.answers import example
from tests.support.asgi import requested
from tests.support.idle import replace
from tests.support.inline_loop import run

STATE = example(StandbyState, name="b", role="standby", epoch=4, other={"name": "a", "address": "10.0.0.1"})
TEXT = "this appliance is the standby of a (10.0.0.1); give the command there"
ENROLMENT = json.loads(Path(examples.__file__).with_name("examples.json").read_text())["Enrolment"]
ROW, TOKEN = make_token("alice", "admin", now=0.0, seconds=1e10)


def control_link() -> ControlLink:
    async def ask(
        request: AdminRequest[A], _bearer: Bearer | None, _seconds: float | None = None
    ) -> AdminAnswer[Any]:
        wants_state = isinstance(request, standby_requests.StandbyWanted)
        return AdminAnswer(True, STATE) if wants_state else on_standby(STATE)

    link = ControlLink(lambda _tokens: None, lambda: None)
    replace(link, ask=ask)
    return link


@pytest.fixture(scope="module")
def gate() -> RequestGate:
    door, control = TokenAuthenticator(10, lambda _token: None), control_link()
    journal = Journal(lambda _call: None)
    door.state([TokenKept(ROW.id, ROW.name, ROW.role, ROW.salt, ROW.hash, ROW.expires)])
    history = SampleHistory(lambda: measures_of(control))
    app = build_app(Services(Settings(), control, door, journal, asyncio.Event(), history))
    run(history.look())
    return RequestGate(app, limits=ApiLimits(), doorkeeper=door, journal=journal, names=["api"])


def asked(gate: RequestGate, method: str, target: str, **more: Any) -> httpx.Response:
    headers = {"Authorization": f"Bearer {TOKEN}", "If-Match": "*"}
    return requested(gate, method, target, headers=headers, **more)


@pytest.mark.parametrize(
    ("method", "target"),
    [
        ("GET", "/v1/status"), ("GET", "/v1/graph"), ("GET", "/v1/live"), ("GET", "/v1/policy"),
        ("GET", "/v1/hosts"), ("GET", "/v1/challenge"), ("POST", "/v1/policy/reload"), ("POST", "/v1/hosts/reload"),
        ("POST", "/v1/standby/switch"), ("DELETE", "/v1/blocks/10.0.0.7"),
    ],
)  # fmt: skip
def test_the_problem_names_the_active_appliance(gate: RequestGate, method: str, target: str) -> None:
    answer = asked(gate, method, target)
    problem = answer.json()
    found = [problem[name] for name in ("type", "active", "detail")]
    assert (answer.status_code, found) == (503, ["urn:rosrv:problem:standby", "10.0.0.1", TEXT])
    assert 1 <= int(answer.headers["Retry-After"]) <= 10


def test_a_host_that_enrols_gets_the_same_problem(gate: RequestGate) -> None:
    """A kit's script learns from it at which address it must enrol."""
    answer = requested(gate, "POST", "/v1/enrol", json=ENROLMENT)
    assert (answer.status_code, answer.json()["active"]) == (503, "10.0.0.1")


def test_its_state_and_metrics_are_served(gate: RequestGate) -> None:
    assert asked(gate, "GET", "/v1/standby").json()["other"]["name"] == "a"
    page = asked(gate, "GET", "/metrics")
    assert page.status_code == 200
    assert 'rosrv_standby_role{role="standby"} 1.0' in page.text


def test_no_other_problem_has_the_address(gate: RequestGate) -> None:
    answer = requested(gate, "GET", "/v1/status", headers={"Authorization": "Bearer wrong"})
    assert (answer.status_code, "active" in answer.json()) == (401, False)
    assert "active" not in asked(gate, "GET", "/v1/nothing").json()
