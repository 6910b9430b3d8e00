"""Access tokens over REST: admins see them and end them; nobody makes one."""

import json

import pytest

from tests.support.appliance import Appliance
from tests.support.rest import Rest


def made(appliance: Appliance, name: str, role: str) -> str:
    """A token, made on the machine."""
    return str(json.loads(appliance.rosrv("token", "add", name, "--role", role, "--json").stdout)["token"])


def test_admins_see_and_end_them(running: Appliance, rest: Rest) -> None:
    """The list has no secret; a token that is ended is 401 at once, and it is recorded who ended it."""
    secret = made(running, "bob", "operator")
    bob = rest.with_token(secret)
    assert bob.get("/v1/whoami").json["role"] == "operator"
    listed = rest.get("/v1/tokens")
    rows = {one["name"]: one for one in listed.json["tokens"]}
    assert (rows["bob"]["role"], rows["bob"]["revoked"]) == ("operator", None)
    assert secret.split("_", 2)[2].encode() not in listed.body
    ended = rest.request("DELETE", "/v1/tokens/bob")
    assert ended.status == 200
    assert ended.json["revoked"] is not None
    assert bob.get("/v1/whoami").status == 401
    again = rest.request("DELETE", "/v1/tokens/bob")
    assert again.status == 422
    assert "there is no token" in again.json["detail"]
    calls = running.recorded("--event", "rest call", "--topic", "/v1/tokens/bob")
    assert {one["detail"]["who"] for one in calls} == {"first"}


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_others_do_not(running: Appliance, rest: Rest, role: str) -> None:
    """Neither a list nor an end for viewers and operators; not even of their own."""
    other = rest.with_token(made(running, f"a-{role}", role))
    assert other.get("/v1/tokens").status == 403
    assert other.request("DELETE", f"/v1/tokens/a-{role}").status == 403
    assert other.get("/v1/whoami").status == 200


def test_nobody_makes_one(rest: Rest) -> None:
    """There is no way: not for admins, by no method."""
    for method in ("POST", "PUT", "PATCH"):
        for path in ("/v1/tokens", "/v1/tokens/mallory"):
            body = json.dumps({"name": "mallory", "role": "admin", "seconds": 3600}).encode()
            answer = rest.request(method, path, body, {"Content-Type": "application/json", "If-Match": "*"})
            allowed = "DELETE" if path.endswith("mallory") else "GET"
            assert (answer.status, answer.headers.get("allow")) == (405, allowed), (method, path)
    assert "mallory" not in {one["name"] for one in rest.get("/v1/tokens").json["tokens"]}
