"""Choose the users of the children.

Started as root, each role has its own user: the one with the role's name in the user database, otherwise a reserved
numeric id (so the appliance also runs in a container without these users). Otherwise everything runs as the caller.
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
}


@dataclass(frozen=True)
class Account:
    """A user as the kernel knows it."""

    name: str
    uid: int
    gid: int


def account_of(user: str, group: str | None = None) -> Account:
    """Return the account of a role's user, in the group of the user `group` if given.

    Raises `KeyError` for a user without a role.
    """
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
