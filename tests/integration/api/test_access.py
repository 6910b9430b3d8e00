import contextlib
import http.client
import json
import os
from pathlib import Path

import pytest

from tests.support.appliance import Appliance
from tests.support.rest import Rest


@pytest.fixture
def rest(running: Appliance) -> Rest:
    return running.rest()


def new_token(appliance: Appliance, name: str, role: str, expires: str = "1h") -> str:
    made = appliance.rosrv("token", "add", name, "--role", role, "--for", expires, "--json").stdout
    return str(json.loads(made)["token"])


@pytest.mark.real
def test_a_revoked_token_ends_at_once(running: Appliance, rest: Rest) -> None:
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


def test_a_body_too_large_is_refused_unread(rest: Rest) -> None:
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
        pass  # cut off while still sending: the request was refused as well
    finally:
        pieces.close()
    assert rest.get("/v1/status").status == 200


def test_a_flood_of_one_host_is_rate_limited(tmp_path: Path) -> None:
    config = tmp_path / "appliance.yaml"
    config.write_text("api: 127.0.0.1:0\napi_tls: off\napi_limits: {requests_per_second: 1, burst: 100}\n")
    with Appliance(options=("--config", str(config))) as appliance:
        rest = appliance.rest().impatient()
        anonymous = rest.with_token(None)
        statuses = [
            anonymous.get("/v1/status", Authorization=f"Bearer rosrv_{n:012x}_{'A' * 43}").status
            for n in range(30)
        ]
        assert statuses[0] == 401
        assert 429 in statuses[-10:]
        assert rest.get("/v1/status").status == 200  # a host with a valid token is still served
        answers = [rest.get("/healthz") for _ in range(400)]
        refused = [answer for answer in answers if answer.status == 429]
        assert refused
        assert int(refused[0].headers["retry-after"]) >= 1


def test_the_first_token_is_shown_once(running: Appliance) -> None:
    token = running.ready["token"]
    assert list(running.ready) == ["event", "master", "api", "revision", "token", "warnings"]
    assert running.stop() == 0
    running.start()
    assert "token" not in running.ready
    assert running.rest(token).get("/v1/status").status == 200
    read = 0
    for file in (Path(folder, name) for folder, _, names in os.walk(running.state) for name in names):
        with contextlib.suppress(FileNotFoundError):  # the appliance removes its temporary files
            if file.is_file() and not file.is_socket():
                assert token.split("_", 2)[2].encode() not in file.read_bytes(), file
                read += 1
    assert read
