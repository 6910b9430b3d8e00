"""Choose the users of the children.

As root, each role has its own user: that with its name, or else a reserved numeric id, as in a container.
"""

import os
import pwd
from dataclasses import dataclass, replace

NUMERIC_IDS = {
    "rosrv": 61011,
    "rosmaster": 61012,
    "rosrv-relay": 61013,
    "rosrv-api": 61014,
    "rosrv-signer": 61015,
    "rosrv-ipsec": 61016,
    "rosrv-syslog": 61017,
    "rosrv-rosout": 61018,
    "rosrv-recorder": 61019,
    "rosrv-compiler": 61020,
    "rosrv-lease": 61021,
    "rosrv-bundles": 61022,
    "rosrv-fleet": 61023,
    "rosrv-doors": 61024,
    "rosrv-sso": 61025,
    "rosrv-hook": 61026,
}


@dataclass(frozen=True)
class Account:
    """A user with its numeric ids."""

    name: str
    uid: int
    gid: int


def account_of(user: str, group: str | None = None) -> Account:
    """Return the account of a user; `group` names the user whose group replaces its own. Raises `KeyError`."""
    if group is not None:
        return replace(account_of(user), gid=account_of(group).gid)
    numeric = NUMERIC_IDS[user]
    if os.geteuid() != 0:
        return Account(user, os.geteuid(), os.getegid())
    try:
        entry = pwd.getpwnam(user)
    except KeyError:
        return Account(user, numeric, numeric)
    return Account(user, entry.pw_uid, entry.pw_gid)
