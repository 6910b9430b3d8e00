"""Hosts over REST without tunnels (isolation none): rights, refusals, and their texts.

With tunnels: tests/system/ipsec/test_enrolment.py.
"""

import json
from typing import Any

import pytest

from appliance.ipsec.requests import make_key, signing_request
from tests.support.appliance import Appliance
from tests.support.rest import Answer, Rest

TOKEN = "rosrv-enrol_" + "0" * 12 + "_" + "x" * 43


@pytest.fixture(scope="module")
def viewer(running: Appliance, rest: Rest) -> Rest:
    """Return a REST client of a viewer."""
    return rest.with_token(running.rosrv("token", "add", "looker", "--role", "viewer").stdout.strip())


@pytest.fixture(scope="module")
def operator(running: Appliance, rest: Rest) -> Rest:
    """Return a REST client of an operator."""
    return rest.with_token(running.rosrv("token", "add", "oper", "--role", "operator").stdout.strip())


@pytest.fixture
def nobody(rest: Rest) -> Rest:
    """Return a REST client without a token."""
    return rest.with_token(None)


def problem(answer: Answer, status: int, kind: str) -> str:
    """Return the detail of a problem, which must have this status and kind."""
    assert answer.status == status, answer.body
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json["type"] == f"urn:rosrv:problem:{kind}"
    return str(answer.json["detail"])


def put(rest: Rest, path: str, body: Any, match: str = "*") -> Answer:
    """PUT JSON."""
    headers = {"Content-Type": "application/json", "If-Match": match}
    return rest.request("PUT", path, json.dumps(body).encode(), headers)


def delete(rest: Rest, path: str, **headers: str) -> Answer:
    """DELETE."""
    return rest.request(
        "DELETE", path, None, {name.replace("_", "-"): text for name, text in headers.items()}
    )


def test_viewers_may_read_the_list(viewer: Rest, nobody: Rest) -> None:
    """A viewer gets the list with its ETag; absent values are null or empty, and without a token it is refused."""
    answer = viewer.get("/v1/hosts")
    assert answer.status == 200
    assert answer.etag == f'"{answer.json["revision"]}"'
    assert (answer.json["esp"], answer.json["hosts"]) == (None, [])
    problem(nobody.get("/v1/hosts"), 401, "not-recognised")
    problem(viewer.get("/v1/hosts/laptop"), 404, "unknown")


def test_changes_that_are_rejected(rest: Rest) -> None:
    """Another table of hosts, an unknown host and an invalid body are refused with a reason."""
    new = {"name": "laptop", "endpoint": "192.168.1.20"}
    problem(delete(rest, "/v1/hosts/laptop", If_Match='"99999"'), 412, "changed-meanwhile")
    assert "enrolled are: none" in problem(delete(rest, "/v1/hosts/laptop", If_Match="*"), 404, "unknown")
    for bad in (
        {"name": "../a"},
        {"endpoint": "a b"},
        {"how": "post"},
        {"days": 0},
        {"open": ["ssh"]},
        {"x": 1},
    ):
        problem(rest.post("/v1/hosts", new | bad, match="*"), 422, "bad-input")
    problem(rest.post("/v1/hosts", new | {"ports": "70000"}, match="*"), 422, "bad-input")
    assert "hosts in tunnels reach the appliance at" in problem(
        rest.post("/v1/hosts", new | {"how": "kit"}, match="*"), 422, "refused"
    )
    assert "isolation: none has no tunnels" in problem(rest.post("/v1/hosts", new, match="*"), 422, "refused")


def test_wrong_enrolment_tokens_are_slowed_down(running: Appliance, nobody: Rest) -> None:
    """Each is recorded; after several of them the host has to wait, before the token is checked."""
    body = {"token": TOKEN, "request": signing_request(make_key(), "laptop").decode()}
    assert "already used" in problem(nobody.post("/v1/enrol", body), 403, "not-recognised")
    assert running.recorded("--event", "enrolment refused")
    problem(nobody.post("/v1/enrol", body | {"token": "rosrv_0_0"}), 422, "bad-input")
    problem(nobody.post("/v1/enrol", body | {"request": "x" * 30_000}), 413, "too-large")
    for _attempt in range(200):
        answer = nobody.impatient().post("/v1/enrol", body)
        if answer.status == 429:
            break
    assert int(answer.headers["retry-after"]) >= 1
    problem(answer, 429, "too-many-failures")


def test_renewal_outside_a_tunnel_is_refused(running: Appliance, nobody: Rest) -> None:
    """A renewal outside a tunnel is refused, with any credentials."""
    body = {"request": signing_request(make_key(), "laptop").decode(), "proof": "AAAA"}
    problem(nobody.post("/v1/hosts/laptop/renew", body), 403, "not-recognised")
    problem(nobody.post("/v1/hosts/laptop/renewed"), 403, "not-recognised")
    assert running.recorded("--event", "renewal refused")


def test_the_authority_and_its_list_are_public(nobody: Rest) -> None:
    """Every holder of an old list of revocations can get a new one."""
    assert nobody.get("/v1/authority").body.startswith(b"-----BEGIN CERTIFICATE-----")
    assert nobody.get("/v1/revocations").body.startswith(b"-----BEGIN X509 CRL-----")


def test_checked_ports_of_a_machine(rest: Rest, operator: Rest, viewer: Rest) -> None:
    """Operators set the checked ports, viewers see them, and they change the ETag; an unknown name is refused."""
    before = rest.get("/v1/hosts").etag
    told = {"state": "open", "open": [40001, 40000]}
    answer = put(operator, "/v1/hosts/10.0.0.7/ports", told, match=before)
    assert answer.status == 200, answer.body
    assert (answer.json["open"], answer.json["who"]) == ([40000, 40001], "oper")
    problem(put(operator, "/v1/hosts/10.0.0.7/ports", told, match=before), 412, "changed-meanwhile")
    (machine,) = viewer.get("/v1/hosts").json["machines"]
    assert (machine["address"], machine["ports"]["state"]) == ("10.0.0.7", "open")
    problem(put(operator, "/v1/hosts/nobody/ports", told), 404, "unknown")


def test_reload_of_hosts_yaml(operator: Rest) -> None:
    """Without a file, no host is declared and no host diverges from the file."""
    answer = operator.post("/v1/hosts/reload", match="*")
    assert answer.status == 200, answer.body
    assert (answer.json["declared"], answer.json["divergence"]) == ([], [])
