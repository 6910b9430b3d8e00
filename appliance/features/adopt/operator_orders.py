"""Show the supervisor that an operator of this machine began an adoption or a release.

Control orders the steps of both, and is not trusted: it can neither write nor repeat this file, which only root writes,
and which the supervisor removes. It is a symbolic link whose target is the order, and so needs no room on a full disk.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import msgspec

from appliance.base import clock
from appliance.network.namespaces import NetworkError

ADOPT: Literal["adopt"] = "adopt"
RELEASE: Literal["release"] = "release"
_FILE = Path(
    "run", "adopt-order.json"
)  # in the state directory; the folder is root's, and empty after a start
_SECONDS = 120.0  # for so long an order is valid


class _Order(msgspec.Struct, frozen=True):
    what: Literal["adopt", "release"]
    since_boot: float


@contextlib.contextmanager
def show_order(state: Path, what: Literal["adopt", "release"]) -> Iterator[None]:
    """Show the order while control carries it out. Raises `NetworkError`, except where no appliance has run yet."""
    file = state / _FILE
    try:
        file.unlink(missing_ok=True)
        file.symlink_to(msgspec.json.encode(_Order(what, clock.since_boot())).decode())
    except FileNotFoundError:
        pass  # no appliance has run in this state directory
    except OSError as error:
        raise NetworkError(f"{file} cannot be written: {error.strerror}") from None
    try:
        yield
    finally:
        file.unlink(missing_ok=True)


def take_order(state: Path, what: Literal["adopt", "release"]) -> bool:
    """Return whether an operator ordered this in the last two minutes; the order is then used up."""
    file = state / _FILE
    try:
        if file.lstat().st_uid != os.geteuid():
            return False
        found = msgspec.json.decode(str(file.readlink()), type=_Order)
    except (OSError, ValueError):
        return False
    if found.what != what or not 0 <= clock.since_boot() - found.since_boot <= _SECONDS:
        return False
    file.unlink(missing_ok=True)
    return True
