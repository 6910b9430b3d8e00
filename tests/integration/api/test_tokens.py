"""Access tokens over REST: admins list and revoke tokens, but cannot create any."""

import json

from tests.support.appliance import Appliance
from tests.support.rest import Rest


def made(appliance: Appliance, name: str, role: str) -> str:
    """Make a token on the machine."""
    return str(json.loads(appliance.rosrv("token", "add", name, "--role", role, "--json").stdout)["token"])


def test_admins_list_and_revoke_tokens(running: Appliance, rest: Rest) -> None:
    """The list contains no secret; a revoked token gets 401 at once, and the record names the admin."""
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
