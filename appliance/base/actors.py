"""Name the authors of revisions and records, including programs, and the hosts that are charged."""

OPERATOR = "operator"
"""The author of orders on the admin socket, which needs no token."""
DISK = "disk"
"""The author of a revision that was read from the disk, at a start or by a signal to the appliance."""
UNCONFIRMED = "not confirmed in time"
"""The author of an automatic rollback. No token has one of these three names."""

ROBOT, APPLIANCE, UNKNOWN = "robot", "appliance", "unknown hosts"
"""Acts are charged to these, or to a host or network as the policy names it."""


def actor(who: str) -> str:
    return f"the appliance ({who})" if who in (DISK, UNCONFIRMED) else who
