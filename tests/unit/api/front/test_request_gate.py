import asyncio
import re
from collections.abc import AsyncIterator
from functools import partial

import httpx
import pytest
from starlette.responses import StreamingResponse

from appliance.base.head_requests import AnswersHead
from tests.support.asgi import requested
from tests.support.asgi import sent as sent_to
from tests.unit.api.routes.test_operation_routes import BY_HAND, routes, world


def sent(method: str, path: str, headers: dict[str, str], host: str = "10.0.0.1") -> httpx.Response:
    return world().play(lambda: sent_to(world().gate, method, path, host, headers=headers))


def get(path: str, **headers: str) -> httpx.Response:
    return sent("GET", path, {"Authorization": f"Bearer {world().tokens.texts['viewer']}"} | headers)


def test_every_route_but_the_public_ones_needs_a_token() -> None:
    without_roles = BY_HAND[None]
    for route in [*routes(), "GET /v1/nothing/here", "POST /v1/tokens"]:
        method, path = re.sub(r"{\w+}", "laptop", route).split()
        answer = sent(method, path, {})
        if route not in without_roles:
            assert (answer.status_code, answer.json()["type"]) == (401, "urn:rosrv:problem:not-recognised"), (
                route
            )
            assert answer.headers["www-authenticate"].startswith("Bearer")
            assert answer.headers["content-type"] == "application/problem+json"
    for path in ("/healthz", "/v1/healthz", "/v1/openapi.json"):
        assert sent("GET", path, {}).status_code == 200


def test_an_invalid_token_is_refused() -> None:
    right = f"Bearer {world().tokens.texts['viewer']}"
    secret = right[:-4] + ("AAAA" if not right.endswith("AAAA") else "BBBB")
    unknown = "bearer rosrv_0123456789ab_" + "A" * 43
    for number, header in enumerate(
        ("", "Bearer", "Bearer ", "Bearer x", "Basic Zmlyc3Q6eA==", unknown, secret)
    ):
        answer = sent("GET", "/v1/status", {"Authorization": header}, host=f"10.0.7.{number}")
        assert answer.status_code == 401, header
    assert get("/v1/status").status_code == 200


@pytest.mark.parametrize(
    ("name", "status"),
    [
        *((name, 421) for name in ("evil.example", "evil.example:443", "127.0.0.1.evil.example", "")),
        *((name, 200) for name in ("localhost", "LocalHost:8443", "127.0.0.1", "[::1]:1", "10.0.0.9", "API")),
    ],
)
def test_only_its_own_names_are_accepted(name: str, status: int) -> None:
    for path in ("/v1/status", "/healthz"):
        assert get(path, Host=name).status_code == status


@pytest.mark.parametrize(
    ("origin", "status"),
    [("https://evil.example", 403), ("null", 403), ("https://api", 403), ("http://api", 200)],
)
def test_other_origins_are_refused(origin: str, status: int) -> None:
    for method in ("GET", "OPTIONS", "POST"):
        answer = sent(
            method,
            "/v1/policy",
            {"Origin": origin, "Authorization": f"Bearer {world().tokens.texts['viewer']}"},
        )
        assert ("foreign-origin" in answer.text) is (status == 403)
        assert not any(header.startswith("access-control") for header in answer.headers)
    assert get("/v1/status", Origin=origin).status_code == status


def test_a_body_that_is_too_large_names_the_setting_and_another_way() -> None:
    token = {"Authorization": f"Bearer {world().tokens.texts['admin']}"}
    for path, headers, way in (("/v1/policy", token, True), ("/v1/enrol", {}, False)):
        answer = sent("POST", path, {"Content-Length": str(1 << 30)} | headers)
        assert (answer.status_code, answer.json()["type"]) == (413, "urn:rosrv:problem:too-large")
        assert [part in answer.json()["detail"] for part in ("api_limits.body_bytes", "rosrv on the")] == [
            way,
            way,
        ]


def test_answers_are_hardened() -> None:
    for answer in (get("/v1/status"), get("/nowhere"), sent("GET", "/metrics", {})):
        assert answer.headers["cache-control"] == "no-store"
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
        assert "server" not in answer.headers


def test_probes_are_not_recorded() -> None:
    world().trail.records.clear()
    assert sent("GET", "/healthz", {}).status_code == 200
    assert world().trail.records == []


@pytest.mark.parametrize("path", ["/v1/status", "/console", "/healthz", "/v1/openapi.json", "/v1/nothing"])
def test_head_is_answered_like_get_without_the_body(path: str) -> None:
    token = {"Authorization": f"Bearer {world().tokens.texts['viewer']}"}
    whole, head = (
        world().play(partial(sent_to, AnswersHead(world().gate), method, path, headers=token))
        for method in ("GET", "HEAD")
    )
    assert whole.content
    assert (head.status_code, head.headers, head.content) == (whole.status_code, whole.headers, b"")


def test_head_of_an_answer_that_never_ends_ends() -> None:
    async def endless() -> AsyncIterator[bytes]:
        while True:
            await asyncio.sleep(0)
            yield b"a record\n"

    app = AnswersHead(StreamingResponse(endless(), media_type="application/x-ndjson"))
    head = requested(app, "HEAD", "/v1/audit/follow")
    assert (head.status_code, head.content) == (200, b"")
