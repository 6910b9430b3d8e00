"""The membership of an appliance in a fleet: the collector's invitation, and the settings that a join keeps.

The settings (`joined/fleet.json` in the state directory) apply unless `appliance.yaml` names a collector.
"""

from pathlib import Path
from typing import Annotated, Any

import msgspec

FOLDER = "joined"
SETTINGS = "fleet.json"
AUTHORITY, CERTIFICATE, KEY, RECEIPT_KEY = "collector.pem", "robot.pem", "robot.key", "receipts.pub"
JOIN_PATH = "/v1/join"
"""The path of the collector that takes a `JoinRequest`."""

_Name = Annotated[str, msgspec.Meta(pattern=r"^[a-z0-9][a-z0-9._-]{0,62}\Z")]
_Url = Annotated[str, msgspec.Meta(pattern=r"^https://[0-9a-fA-F.:\[\]]{3,60}\Z")]
_Group = Annotated[str, msgspec.Meta(pattern=r"^([a-z0-9][a-z0-9-]{0,62}+/[a-z0-9][a-z0-9-]{0,62}+)?\Z")]
_Pem = Annotated[str, msgspec.Meta(max_length=16_384)]
_Token = Annotated[str, msgspec.Meta(pattern=r"^rosrv-join_[A-Za-z0-9_-]{43}\Z")]


class Invitation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The robot's name, the collector, and a token for one use until `expires` (seconds since the epoch)."""

    robot: _Name
    group: _Group = ""
    collector: _Url
    authority: _Pem
    receipt_key: _Pem
    token: _Token
    expires: float


class JoinRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The token, the public key of the robot's audit log and its certificate (PEM)."""

    token: _Token
    key: _Pem
    certificate: _Pem


def settings_of(invitation: Invitation) -> dict[str, object]:
    site, _, group = invitation.group.partition("/")
    section: dict[str, Any] = {
        "collector": invitation.collector, "robot": invitation.robot, "ca": AUTHORITY, "certificate": CERTIFICATE,
        "key": KEY, "receipt_key": RECEIPT_KEY,
    }  # fmt: skip
    return section | ({"bundles": {"site": site, "group": group}} if group else {})


def joined_settings(state: Path) -> dict[str, Any]:
    """Return the settings of the last join with absolute paths, or empty ones before the first join.

    Raises `OSError`, and `ValueError` for a file that is not JSON.
    """
    folder = (state / FOLDER).absolute()
    try:
        section: dict[str, Any] = msgspec.json.decode((folder / SETTINGS).read_bytes(), type=dict[str, Any])
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except ValueError as error:
        raise ValueError(f"{error}; join again: rosrv fleet join FILE") from error
    files = {
        name: str(folder / section[name])
        for name in ("ca", "certificate", "key", "receipt_key")
        if name in section
    }
    return section | files
