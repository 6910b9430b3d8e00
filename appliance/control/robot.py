"""The group `robot`: the machine the appliance is put next to, as it is seen from inside."""

import ipaddress
import socket
import struct
from pathlib import Path

from appliance.config import Settings
from appliance.policy.model import Address

_ROUTES = Path("/proc/net/route")


def robot_addresses(settings: Settings) -> list[Address]:
    """Loopback with `isolation: none`; else the gateway of the default route."""
    if settings.isolation == "none":
        return [ipaddress.ip_address("127.0.0.1"), ipaddress.ip_address("::1")]
    gateway = _default_gateway(_ROUTES.read_text(encoding="ascii"))
    return [gateway] if gateway is not None else []


def own_address(settings: Settings) -> str:
    """The address at which the robot reaches the appliance when it listens on all of them."""
    robots = robot_addresses(settings)
    if settings.isolation == "none" or not robots:
        return "127.0.0.1"
    family = socket.AF_INET if robots[0].version == 4 else socket.AF_INET6
    with socket.socket(family, socket.SOCK_DGRAM) as sock:
        sock.connect(
            (str(robots[0]), 9)
        )  # a datagram socket that connects sends nothing: it only picks a route
        return str(sock.getsockname()[0])


def _default_gateway(table: str) -> Address | None:
    """The gateway in the kernel's routing table (`/proc/net/route`)."""
    for line in table.splitlines()[1:]:
        fields = line.split()
        if fields[1] == "00000000" and fields[2] != "00000000":
            return ipaddress.ip_address(socket.inet_ntoa(struct.pack("<I", int(fields[2], 16))))
    return None
