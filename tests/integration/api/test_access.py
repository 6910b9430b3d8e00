"""Who gets in over REST, with the appliance as a user starts it."""

import http.client
import json
import select
import socket
import stat
from contextlib import ExitStack
from pathlib import Path

import pytest

from appliance.quotas.table import REST_CONNECTIONS
from tests.support.appliance import Appliance
from tests.support.rest import Rest
from tests.support.waiting import eventually

WRITES = ("/v1/policy", "/v1/policy/rollback", "/v1/policy/reload", "/v1/policy/confirm")
READS = (
    "/v1/status", "/v1/inventory", "/v1/policy", "/v1/policy/revisions", "/v1/graph", "/v1/audit", "/v1/audit/1",
    "/v1/audit/export", "/v1/audit/stream", "/v1/monitors", "/v1/monitors/any", "/v1/tokens", "/v1/hosts", "/v1/whoami",
    "/v1/recordings", f"/v1/recordings/{'a' * 20}/bag",
    "/metrics", "/v1/metrics", "/v1/nothing/here",
)  # fmt: skip


@pytest.fixture
def rest(running: Appliance) -> Rest:
    """REST as the holder of the first token, where it is now: a test starts the appliance anew."""
    return running.rest()


def new_token(appliance: Appliance, name: str, role: str, expires: str = "1h") -> str:
    """A token, made as an operator makes one."""
    made = appliance.rosrv("token", "add", name, "--role", role, "--expires", expires, "--json").stdout
    return str(json.loads(made)["token"])


def test_health_needs_no_token_and_nothing_else_goes_without(rest: Rest) -> None:
    """The probes and the contract answer anybody; everything else, known or not, is 401 without a token."""
    stranger = rest.with_token(None)
    for path in ("/healthz", "/readyz", "/v1/healthz", "/v1/readyz", "/v1/openapi.json"):
        assert stranger.get(path).status == 200
    for path in READS:
        answer = stranger.get(path)
        assert answer.status == 401, path
        assert answer.headers["www-authenticate"].startswith("Bearer")
        assert answer.headers["content-type"] == "application/problem+json"
    for path in WRITES:
        assert stranger.post(path, {}).status == 401


@pytest.mark.parametrize(
    "header",
    ["Bearer", "Bearer ", "Bearer nonsense", "Basic Zmlyc3Q6eA==", "bearer rosrv_0123456789ab_" + "A" * 43],
)
def test_what_is_no_token_is_refused(rest: Rest, header: str) -> None:
    """Another scheme, an empty, a malformed and an unknown token are 401."""
    assert rest.with_token(None).get("/v1/status", Authorization=header).status == 401


def test_a_wrong_secret_is_refused(rest: Rest) -> None:
    """The id of a token that exists opens nothing."""
    assert rest.token is not None
    wrong = rest.token[:-4] + ("AAAA" if not rest.token.endswith("AAAA") else "BBBB")
    assert rest.with_token(wrong).get("/v1/status").status == 401
    assert rest.get("/v1/status").status == 200


def test_each_role_may_what_it_is_for(running: Appliance, rest: Rest) -> None:
    """A viewer looks, an operator also reloads and goes back, an admin also loads new rules."""
    viewer = rest.with_token(new_token(running, "viewer-1", "viewer"))
    operator = rest.with_token(new_token(running, "operator-1", "operator"))
    for path in ("/v1/status", "/v1/policy", "/v1/graph", "/v1/audit", "/metrics"):
        assert viewer.get(path).status == 200
    text = running.policy_file.read_text()
    for path in WRITES:
        assert viewer.post(path, {"text": text} if path == "/v1/policy" else {}, match="*").status == 403, (
            path
        )
    assert viewer.get("/v1/audit/verify").status == 403
    assert operator.get("/v1/audit/verify").status == 200
    assert operator.post("/v1/policy/reload", match="*").status == 200
    assert operator.post("/v1/policy?dry_run=1", text).status == 200
    assert operator.post("/v1/policy", text, match="*").status == 403
    assert rest.post("/v1/policy", text, match="*").status == 200


def test_a_revoked_token_ends_at_once(running: Appliance, rest: Rest) -> None:
    """The answer after `rosrv token revoke` is 401; a stream that is open ends and says why."""
    client = rest.with_token(new_token(running, "leaver", "viewer"))
    events = client.events("/v1/audit/stream")
    next(events)
    assert client.get("/v1/status").status == 200
    running.rosrv("token", "revoke", "leaver")
    assert client.get("/v1/status").status == 401
    last = list(events)[-1]
    assert last["event"] == "end"
    again = running.rosrv("token", "revoke", "leaver", check=False)
    assert again.returncode == 1
    assert "no token 'leaver'" in again.stderr


def test_an_expired_token_ends(running: Appliance, rest: Rest) -> None:
    """After its time a token is 401, and the answer says that it expired."""
    client = rest.with_token(new_token(running, "short", "viewer", "0.05m"))
    assert client.get("/v1/status").status == 200
    events = client.events("/v1/audit/stream?event=nothing")
    assert list(events)[-1]["event"] == "end"  # waits until the token ends
    answer = client.get("/v1/status")
    assert answer.status == 401
    assert "expired" in answer.json["detail"]


@pytest.mark.parametrize("name", ["evil.example", "evil.example:443", "127.0.0.1.evil.example", ""])
def test_a_foreign_name_is_refused(rest: Rest, name: str) -> None:
    """A page that got a name of its own to resolve to the appliance (DNS rebinding) reads nothing."""
    assert rest.get("/v1/status", Host=name).status == 421
    assert rest.get("/healthz", Host=name).status == 421


@pytest.mark.parametrize("name", ["localhost", "LocalHost:8443", "127.0.0.1", "[::1]:1", "10.0.0.9"])
def test_addresses_and_localhost_are_its_names(rest: Rest, name: str) -> None:
    """However the appliance is reached by an address, it answers."""
    assert rest.get("/v1/status", Host=name).status == 200


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://127.0.0.1"])
def test_other_sites_may_not_ask(rest: Rest, origin: str) -> None:
    """Whatever a page of another origin asks is 403, and no answer ever has a CORS header."""
    for method in ("GET", "OPTIONS", "POST"):
        answer = rest.request(method, "/v1/policy", None, {"Origin": origin})
        assert answer.status == 403
        assert not any(name.startswith("access-control") for name in answer.headers)
    own = rest.get("/v1/status", Origin=f"https://127.0.0.1:{rest.url.port}")
    assert own.status == 200
    assert not any(name.startswith("access-control") for name in own.headers)


def test_answers_are_hardened(rest: Rest) -> None:
    """No answer is cached, sniffed or framed, and none says what serves it."""
    for answer in (rest.get("/v1/status"), rest.get("/nowhere"), rest.with_token(None).get("/metrics")):
        assert answer.headers["cache-control"] == "no-store"
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
        assert "server" not in answer.headers


def test_a_body_too_large_is_refused_unread(rest: Rest) -> None:
    """A length beyond the limit is answered before the body is sent; so is one sent in pieces."""
    connection = rest.connect()
    connection.putrequest("POST", "/v1/policy")
    for name, value in rest.headers({"Content-Length": "999999999999", "Content-Type": "text/plain"}).items():
        connection.putheader(name, value)
    connection.endheaders()
    assert connection.getresponse().status == 413
    connection.close()
    pieces = rest.connect()
    try:
        pieces.request(
            "POST", "/v1/policy", (b"#" * 65_536 for _ in range(64)), rest.headers(), encode_chunked=True
        )
        assert pieces.getresponse().status == 413
    except (BrokenPipeError, ConnectionResetError, http.client.HTTPException):
        pass  # cut off while it was still sending: refused all the same
    finally:
        pieces.close()
    assert rest.get("/v1/status").status == 200


def test_a_flood_of_one_host_is_slowed_down(tmp_path: Path) -> None:
    """Beyond the burst a host is told to come back later (429, Retry-After); and so is one that guesses tokens."""
    config = tmp_path / "appliance.yaml"
    config.write_text("api: 127.0.0.1:0\napi_tls: off\napi_limits: {requests_per_second: 1, burst: 100}\n")
    with Appliance(options=("--config", str(config))) as appliance:
        rest = appliance.rest().impatient()
        stranger = rest.with_token(None)
        statuses = [
            stranger.get("/v1/status", Authorization=f"Bearer rosrv_{n:012x}_{'A' * 43}").status
            for n in range(30)
        ]
        assert statuses[0] == 401
        assert statuses[-1] == 429
        assert rest.get("/v1/status").status == 200  # who has a good token is let in meanwhile
        answers = [rest.get("/healthz") for _ in range(400)]
        refused = [one for one in answers if one.status == 429]
        assert refused
        assert int(refused[0].headers["retry-after"]) >= 1


def test_without_json_the_first_token_is_in_a_file(tmp_path: Path) -> None:
    """Beside the one line for scripts, the path is printed; the file is its owner's only, the token an admin's."""
    with Appliance(options=("--api", "127.0.0.1:0", "--api-tls", "off"), json=False) as appliance:
        process = appliance.process
        assert process is not None

        def said(text: str) -> str:
            return next((line for line in process.errors if text in line), "")

        eventually(lambda: bool(said("first access token")), "the path of the token is printed")
        path = Path(said("first access token").rpartition(" ")[2])
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert len(process.output().splitlines()) == 1
        url = said("REST: ").partition(" ")[2]
        assert said("Console: ") == f"Console: {url}/console/"
        rest = Rest(url, path.read_text().strip())
        assert rest.post("/v1/policy/reload", match="*").status == 200


def test_clear_text_stays_on_loopback(tmp_path: Path) -> None:
    """`--api-tls off` on another address is an error before anything starts."""
    appliance = Appliance(options=("--api", "0.0.0.0:0", "--api-tls", "off"))
    try:
        with pytest.raises(AssertionError, match="clear text"):
            appliance.start()
    finally:
        appliance.close()


def test_slow_clients_are_cut_off_and_others_served(rest: Rest) -> None:
    """Of connections that say nothing a host has its share, which end; others go on, and then that host, too."""
    assert rest.url.hostname is not None
    with ExitStack() as stack:
        idle = [
            stack.enter_context(socket.create_connection((rest.url.hostname, rest.url.port)))
            for _ in range(200)
        ]

        def ended() -> int:
            return len(select.select(idle, [], [], 0)[0])

        eventually(
            lambda: ended() >= len(idle) - REST_CONNECTIONS.bounds.host,
            "all beyond the share of a host are closed",
        )
        other = rest.connect(source="127.0.0.2")
        other.request("GET", "/healthz")
        assert other.getresponse().status == 200
        other.close()
        eventually(lambda: ended() == len(idle), "those that are left end, too")
        assert rest.with_token(None).get("/healthz").status == 200


def test_who_polls_is_not_sent_again_what_he_has(running: Appliance, rest: Rest) -> None:
    """The hash of what came is all that is sent the second time; a revision's ETag stays for changes alone."""
    for path in ("/v1/inventory", "/v1/policy/revisions", "/v1/tokens", "/v1/openapi.json"):
        first = rest.get(path)
        again = rest.get(path, If_None_Match=first.etag)
        assert (again.status, again.body, again.etag) == (304, b"", first.etag), path
        assert rest.get(path, If_None_Match='"other"').body == first.body
    for path in ("/v1/policy", "/v1/monitors", "/v1/hosts"):
        first = rest.get(path)
        assert rest.get(path, If_None_Match=first.etag).json.keys() == first.json.keys(), path
    assert rest.with_token(None).get("/v1/inventory", If_None_Match="*").status == 401
    assert rest.get("/healthz", If_None_Match="*").status == 304
    rest.get("/v1/whoami", If_None_Match="*")  # recorded after what came before it
    running.recorded("--event", "rest call", "--topic", "/v1/whoami")
    probes = running.audit(
        "--event", "rest call", "--topic", "*healthz"
    )  # those that were refused are recorded
    assert [one for one in probes if one["detail"]["status"] in (200, 304)] == []


def test_the_first_token_is_shown_once(running: Appliance) -> None:
    """With --json it is in the ready line of the first start and of no other; it works after a restart."""
    token = running.ready["token"]
    assert list(running.ready) == ["event", "master", "api", "revision", "token"]
    assert running.stop() == 0
    running.start()
    assert "token" not in running.ready
    assert running.rest(token).get("/v1/status").status == 200
    for file in running.state.rglob("*"):
        if file.is_file() and not file.is_socket():
            assert token.split("_", 2)[2].encode() not in file.read_bytes(), file
