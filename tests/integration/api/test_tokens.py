"""Access tokens over REST: admins list and revoke tokens, but cannot create any."""

import json

from tests.support.appliance import Appliance
from tests.support.rest import Rest
from tests.support.waiting import eventually


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


def test_a_rotated_token_replaces_the_earlier_one(running: Appliance, rest: Rest) -> None:
    """Both are valid in the grace time; a rotation without it ends both at once, with their open streams."""
    old = rest.with_token(made(running, "dash", "viewer"))
    new = rest.with_token(rotated(running, "--grace", "10m"))
    events = old.events("/v1/audit/stream")
    next(events)
    assert (old.get("/v1/status").status, new.get("/v1/whoami").json["role"]) == (200, "viewer")
    newest = rest.with_token(rotated(running))
    assert [one.get("/v1/status").status for one in (old, new, newest)] == [401, 401, 200]
    assert list(events)[-1]["event"] == "end"
    [first, second] = running.recorded("--event", "token rotated")[::-1]
    assert (first["detail"]["who"], len(second["detail"]["earlier"])) == ("operator", 2)


def rotated(appliance: Appliance, *options: str) -> str:
    """Rotate the token of the dashboard on the machine, and return the new text."""
    return str(json.loads(appliance.rosrv("token", "rotate", "dash", "--json", *options).stdout)["token"])


def test_the_last_use_survives_a_restart(running: Appliance) -> None:
    """An unused token has none; requests that are served without RVMaster count too."""
    rest = running.rest()
    used = rest.with_token(made(running, "used", "viewer"))
    made(running, "unused", "viewer")
    assert used.get("/v1/audit/summary").status == 200

    def uses() -> dict[str, float | None]:
        listed = running.rest().get("/v1/tokens").json["tokens"]
        return {one["name"]: one["last_used"] for one in listed if one["name"] in ("used", "unused")}

    eventually(lambda: uses()["used"], "the api reports the use")
    before = uses()
    assert before["unused"] is None
    running.stop()
    running.start()
    assert uses() == before
