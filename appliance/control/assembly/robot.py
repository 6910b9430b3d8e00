"""Find the addresses of the robot's machine, as seen from inside the appliance's isolation."""

import ipaddress
import socket
import struct
from pathlib import Path

from appliance.base.actors import APPLIANCE, ROBOT, UNKNOWN
from appliance.configuration.settings import Settings
from appliance.policy.model import Address, address_of
from appliance.policy.policy import Policy

_ROUTES = Path("/proc/net/route")


def robot_addresses(settings: Settings, robot: str | None = None) -> list[Address]:
    """Return loopback with `isolation: none`, otherwise `robot` or the gateway of the default route."""
    if settings.isolation == "none":
        return [ipaddress.ip_address("127.0.0.1"), ipaddress.ip_address("::1")]
    if robot is not None:
        return [ipaddress.ip_address(robot)]
    gateway = _default_gateway()
    return [gateway] if gateway is not None else []


def charged_to(policy: Policy, host: str) -> str:
    try:
        address = address_of(host)
    except ValueError:
        return APPLIANCE
    if address.is_loopback or any(address in network for network in policy.robot):
        return ROBOT
    return policy.counted_as(address).removesuffix("/32").removesuffix("/128") or UNKNOWN


def own_address(settings: Settings) -> str:
    robots = robot_addresses(settings)
    return "127.0.0.1" if settings.isolation == "none" or not robots else _towards(robots[0])


def master_address(settings: Settings) -> str:
    if settings.isolation != "none" and not robot_addresses(settings):
        for network, gateway in _routes():
            if int(network) and not int(gateway) and network not in settings.ipsec.pool:
                return _towards(network + 1)
    return own_address(settings)


def _towards(peer: Address) -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect((str(peer), 9))  # connecting a datagram socket only selects a route
        return str(sock.getsockname()[0])


def _default_gateway() -> Address | None:
    return next((gateway for network, gateway in _routes() if not int(network) and int(gateway)), None)


def _routes() -> list[tuple[ipaddress.IPv4Address, ipaddress.IPv4Address]]:
    def address(field: str) -> ipaddress.IPv4Address:
        return ipaddress.IPv4Address(struct.pack("<I", int(field, 16)))

    rows = (line.split() for line in _ROUTES.read_text(encoding="ascii").splitlines()[1:])
    return [(address(row[1]), address(row[2])) for row in rows]
