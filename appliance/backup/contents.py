"""What is in a backup, by its name and size: the same rule for who takes one and for who puts one back.

A part of the state directory belongs to a process that may have fallen to a stranger. A name that a terminal would
interpret, or a file without end, is therefore nobody's to keep: it is told.
"""

from pathlib import PurePosixPath

from appliance.supervisor.roles import ROLES

AUDIT_LOG = "control/audit.db"
LARGEST = 1 << 30  # bytes of a file that is no database
MOST_FILES = 10_000  # some twenty are usual
_LONGEST_NAME = 100  # bytes: what an archive holds without a further header
_DATABASES = "control/"  # the only part that has any
# Of a running appliance only, or made anew at the next start. `.ahead`: what the copied database does not have yet.
_PASSING = ("-wal", "-shm", ".lock", ".ahead", ".new", ".sock", ".pid", "strongswan.conf")
_LEFT_OUT = {"rosmaster", "rosout", "recordings"}  # logs of ROS, and what messages said
KEPT_PARTS = frozenset(role.part for role in ROLES) - _LEFT_OUT
"""The folders of a state directory that a backup has."""


class BackupError(Exception):
    """A backup cannot be made or put back; the text says what is in the way, and what to do."""


def is_passing(name: str) -> bool:
    """Whether the file is of a running appliance only."""
    return name.endswith(_PASSING)


def is_database(name: str) -> bool:
    """Whether it is a database: copied by SQLite, of any size."""
    return name.startswith(_DATABASES) and name.endswith(".db")


def trouble_with(name: str, size: int) -> str:
    """Why no backup has a file of a part with this name and size in bytes; empty when it may have it."""
    if not name.isprintable():
        return "has a name that is no text"
    if len(name.encode()) > _LONGEST_NAME:
        return f"has a name of more than {_LONGEST_NAME} bytes"
    if size < 0 or (size > LARGEST and not is_database(name)):
        return f"has {size} bytes"
    return ""


def belongs(name: str, parts: frozenset[str]) -> bool:
    """Whether a name in an archive is that of a file which is kept, below one of `parts`."""
    path = PurePosixPath(name)
    below = len(path.parts) > 1 and path.parts[0] in parts and ".." not in path.parts
    return below and str(path) == name and not is_passing(name)
