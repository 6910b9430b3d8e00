import pytest

from appliance.ipsec.requests import make_key, signing_request
from tests.support.appliance import Appliance
from tests.support.rest import Answer, Rest

TOKEN = "rosrv-enrol_" + "0" * 12 + "_" + "x" * 43


@pytest.fixture
def nobody(rest: Rest) -> Rest:
    return rest.with_token(None)


def problem(answer: Answer, status: int, kind: str) -> str:
    assert answer.status == status, answer.body
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json["type"] == f"urn:rosrv:problem:{kind}"
    return str(answer.json["detail"])


def test_wrong_enrolment_tokens_are_slowed_down(running: Appliance, nobody: Rest) -> None:
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
    body = {"request": signing_request(make_key(), "laptop").decode(), "proof": "AAAA"}
    problem(nobody.post("/v1/hosts/laptop/renew", body), 403, "not-recognised")
    problem(nobody.post("/v1/hosts/laptop/renewed"), 403, "not-recognised")
    assert running.recorded("--event", "renewal refused")


def test_the_authority_and_its_list_are_public(nobody: Rest) -> None:
    assert nobody.get("/v1/authority").body.startswith(b"-----BEGIN CERTIFICATE-----")
    assert nobody.get("/v1/revocations").body.startswith(b"-----BEGIN X509 CRL-----")
