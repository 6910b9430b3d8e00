"""The settings of the witness and of its followers, which the kits have."""

import ipaddress
import json
import os
import re
import stat
from typing import Any, Dict, NamedTuple, Tuple

from appliance.features.standby.witness.errors import WitnessError
from appliance.features.standby.witness.protocol import NAME

_MAX_FOLLOWERS = 32

AppliancePeer = NamedTuple("AppliancePeer", [("address", str), ("key", bytes)])

WitnessSettings = NamedTuple(
    "WitnessSettings",
    [
        ("listen", Tuple[str, int]),
        ("fixed", str),
        ("ports", Tuple[str, ...]),
        ("appliances", Dict[str, AppliancePeer]),
        ("state", str),
        ("followers", Dict[str, AppliancePeer]),
        ("follows_as", str),
    ],
)
"""`fixed` is the address that the robot's nodes use; `ports` are translated to the holder.

`followers` are the other computers that ask the witness. In the settings of a follower, `follows_as` is its name,
`followers` has only itself, and the appliances have no keys.
"""


def read_settings(path: str) -> WitnessSettings:
    """Raise `WitnessError` if other users can read the file, since it has the keys."""
    try:
        with open(path, encoding="utf-8") as file:
            if stat.S_IMODE(os.fstat(file.fileno()).st_mode) & 0o077:
                raise ValueError("other users can read its keys: chmod 600 %s" % path)
            return settings_of(json.loads(file.read(65536)))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = "%s is missing" % error if isinstance(error, KeyError) else str(error)
        raise WitnessError("the settings %s cannot be used: %s" % (path, reason)) from error


def settings_of(body: Dict[str, Any]) -> WitnessSettings:
    host, _, port = body["listen"].rpartition(":")
    follows_as = body.get("follows_as", "")
    appliances = _peers(body["appliances"], keys=not follows_as)
    followers = _peers(body.get("followers", {}), keys=True)
    fixed = {_address(body["fixed"]), _address(host)}
    addresses = fixed.union(one.address for table in (appliances, followers) for one in table.values())
    keys = [one.key for table in (appliances, followers) for one in table.values() if one.key]
    if len(appliances) != 2 or len(set(keys)) != len(keys) or set(appliances) & set(followers):
        raise ValueError(
            "it needs two appliances, and a name and a key of its own for each and each follower"
        )
    if len(addresses) != 4 + len(followers):
        raise ValueError("it needs different addresses: the witness, fixed, two appliances, each follower")
    if len(followers) > _MAX_FOLLOWERS:
        raise ValueError("it has more than %d followers" % _MAX_FOLLOWERS)
    if follows_as and list(followers) != [follows_as]:
        raise ValueError("follows_as must be the only follower in it")
    ports = tuple(_ports(text) for text in body["ports"])
    if not ports:
        raise ValueError("ports is empty; list those of the ROS master and the relay, such as 11311")
    return WitnessSettings(
        (_address(host), int(_ports(port))),
        _address(body["fixed"]),
        ports,
        appliances,
        str(body["state"]),
        followers,
        follows_as,
    )


def _peers(table: Dict[str, Dict[str, str]], keys: bool) -> Dict[str, AppliancePeer]:
    found = {}
    for name, one in table.items():
        if not NAME.match(name):
            raise ValueError("the name %r is not valid; use a-z, 0-9 and -" % name)
        if keys and not re.match(r"[0-9a-f]{64}\Z", one["key"]):
            raise ValueError("the key of %s does not have 64 hexadecimal digits" % name)
        found[name] = AppliancePeer(_address(one["address"]), bytes.fromhex(one["key"]) if keys else b"")
    return found


def _address(text: str) -> str:
    address = ipaddress.IPv4Address(text)
    if address.is_multicast or address.is_unspecified or address.is_loopback:
        raise ValueError("%s cannot be an address of the robot's network" % text)
    return str(address)


def _ports(text: str) -> str:
    first, _, last = text.partition("-")
    if not (first.isdigit() and (last or first).isdigit() and 0 < int(first) <= int(last or first) < 65536):
        raise ValueError("%r is not a port or a range such as 20000-20999" % text)
    return text
