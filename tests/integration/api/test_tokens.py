"""Access tokens over REST: admins list and revoke tokens, but cannot create any."""

import json

from tests.support.appliance import Appliance
from tests.support.rest import Rest


def made(appliance: Appliance, name: str, role: str) -> str:
    """Make a token on the machine."""
    return str(json.loads(appliance.rosrv("token", "add", name, "--role", role, "--json").stdout)["token"])


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
