"""Whom the children run as.

Started as root, each role has a user of its own: the one with the role's name in the user database,
else a numeric id kept for it (so the appliance also runs where nobody made the users, in a container
for example). Started otherwise, everything runs as the caller, and nothing is dropped because nothing
is held.
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
    """The account that a role's user stands for here, in the group of the user `group` if that is given.

    Raises `KeyError` for a user that is no role's.
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
