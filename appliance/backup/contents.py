"""Decide, by name and size, which files a backup contains; making and restoring a backup use the same rule.

Each part of the state belongs to a process that may be compromised, so unusual names and sizes are errors.
"""

from pathlib import PurePosixPath

from appliance.supervisor.roles import ROLES

AUDIT_LOG = "control/audit.db"
LARGEST = 1 << 30  # bytes of a file that is not a database
MAX_FILES = 10_000  # a usual backup has about twenty
_LONGEST_NAME = 100  # bytes that fit into a tar header without an extension
_DATABASES = "control/"  # the only part with databases
# Files that exist only while the appliance runs, or that the next start makes again.
_PASSING = ("-wal", "-shm", ".lock", ".new", ".sock", ".pid", "strongswan.conf")
# The same, but earlier versions backed them up, so `restore` takes them.
_PASSING_NOW = ("fleet/segment.gz", "control/compiled/")
# Logs of ROS, recorded messages, and what the robot knows of the fleet's signatures: older knowledge would weaken it.
_LEFT_OUT = {"rosmaster", "rosout", "recordings", "bundles"}
KEPT_PARTS = frozenset(role.part for role in ROLES) - _LEFT_OUT
"""The folders of a state directory that are backed up."""


class BackupError(Exception):
    """A backup cannot be made or restored."""


def is_passing(name: str) -> bool:
    return name.endswith(_PASSING)


def comes_and_goes(name: str) -> bool:
    """Return whether the running appliance may remove the file at any time, so that a backup leaves it out."""
    return is_passing(name) or name.startswith(_PASSING_NOW)


def is_database(name: str) -> bool:
    return name.startswith(_DATABASES) and name.endswith(".db")


def trouble_with(name: str, size: int) -> str:
    if not name.isprintable():
        return "has a name that is not valid UTF-8"
    if len(name.encode()) > _LONGEST_NAME:
        return f"has a name of more than {_LONGEST_NAME} bytes"
    if size < 0 or (size > LARGEST and not is_database(name)):
        return f"has {size} bytes"
    return ""


def belongs(name: str, parts: frozenset[str]) -> bool:
    path = PurePosixPath(name)
    below = len(path.parts) > 1 and path.parts[0] in parts and ".." not in path.parts
    return below and str(path) == name and not is_passing(name)
