"""Make the memberships of two appliances, and the kits for the robot's computers. No I/O.

All keys and the lease file are new each time: a new kit never changes the lease of an earlier kit, and an old kit
that is installed again grants nothing.
"""

import json
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, NamedTuple

from appliance.features.standby.link_certificates import make_link_certificate
from appliance.features.standby.membership import Membership
from appliance.features.standby.witness.one_file import witness_program
from appliance.features.standby.witness.settings import settings_of

WITNESS_PORT = 7411
_STATE = "/var/lib/rosrv-witness"
_SHUT = "rosrv-witness-shut.service"


@dataclass(frozen=True, kw_only=True)
class PairPlan:
    """The decisions of an operator; `address` and `name` are those of the appliance that has all data."""

    name: str
    address: str
    other: str
    other_address: str
    witness: str
    fixed: str
    port: int
    ports: tuple[str, ...]
    """Ports and ranges, such as `11311` and `19001-26000`."""
    master_port: int
    epoch: int
    """Greater than that of any earlier lease."""
    followers: Mapping[str, str]


class KitFile(NamedTuple):
    name: str
    text: str
    mode: int


class Kits(NamedTuple):
    """The memberships, and the files of each folder: `witness`, `follower-NAME`."""

    own: Membership
    other: Membership
    folders: Mapping[str, tuple[KitFile, ...]]


def make_kits(plan: PairPlan) -> Kits:
    peer_key = secrets.token_hex(32)
    keys = {name: secrets.token_hex(32) for name in (plan.name, plan.other)}
    links = {name: make_link_certificate() for name in keys}
    addresses = {plan.name: plan.address, plan.other: plan.other_address}

    def membership(name: str, other: str) -> Membership:
        return Membership(
            name=name,
            other=other,
            address=addresses[name],
            other_address=addresses[other],
            fixed=plan.fixed,
            witness=plan.witness,
            witness_port=WITNESS_PORT,
            port=plan.port,
            ports=plan.ports,
            witness_key=keys[name],
            peer_key=peer_key,
            certificate=links[name].certificate,
            key=links[name].key,
            other_certificate=links[other].certificate,
        )

    if plan.name == plan.other:
        raise ValueError(f"both appliances have the name {plan.name}: give --name or --other-name")
    followers = {
        name: {"address": address, "key": secrets.token_hex(32)} for name, address in plan.followers.items()
    }
    common: dict[str, Any] = {
        "listen": f"{plan.witness}:{WITNESS_PORT}",
        "fixed": plan.fixed,
        "ports": plan.ports,
        "state": f"{_STATE}/lease-{secrets.token_hex(4)}",
    }
    appliances = {name: {"address": address} for name, address in addresses.items()}
    with_keys = {name: one | {"key": keys[name]} for name, one in appliances.items()}
    settings = {"witness": common | {"appliances": with_keys, "followers": followers}}
    for name, one in followers.items():
        own = {"appliances": appliances, "followers": {name: one}, "follows_as": name}
        settings[f"follower-{name}"] = common | own
    return Kits(
        membership(plan.name, plan.other),
        membership(plan.other, plan.name),
        {folder: _files(plan, body) for folder, body in settings.items()},
    )


def _files(plan: PairPlan, body: dict[str, Any]) -> tuple[KitFile, ...]:
    settings_of(body)  # the computer accepts what this accepts
    service = "rosrv-witness-follow.service" if "follows_as" in body else "rosrv-witness.service"
    values = {
        "name": plan.name,
        "epoch": str(plan.epoch),
        "lease": body["state"],
        "own": plan.address,
        "other": plan.other_address,
        "fixed": plan.fixed,
        "master": str(plan.master_port),
    }
    package = files("appliance.features.standby")
    found = [
        KitFile("witness.py", witness_program(), 0o755),
        KitFile("witness.json", json.dumps(body, indent=2) + "\n", 0o600),
    ]
    for name in (service, _SHUT, "install.sh", "remove.sh"):
        text = package.joinpath("kit_files", name).read_text("utf-8")
        for key, value in values.items():
            text = text.replace(f"@{key}@", value)
        found.append(KitFile(name, text, 0o755 if name.endswith(".sh") else 0o644))
    return tuple(found)
