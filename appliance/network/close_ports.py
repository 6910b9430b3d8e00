"""Closing the ROS ports of the machine that the nodes run on: an nftables file, and putting it in force.

A ROS node listens, for its API and for TCPROS and UDPROS, on ports that the kernel picks from the local
port range. The appliance hides where they are, but a port scanner finds them. The file closes that range
to all but loopback and the appliance:

1. A TCP connection is refused at its SYN, without the connection tracker: connections that are older than
   the file, and all that the machine itself opens, go on.
2. A UDP packet is dropped if the connection tracker sees a new conversation in it: answers to what this
   machine asked (DNS, NTP, DHCP) pass.
3. A connection to the appliance that this machine only forwards (for a container, a virtual machine, a client of its
   hotspot) is dropped if it bears an address of this machine after all translation: the policy would take
   it for the machine. Where a packet came in is known there from Linux 5.7 on; before, the rule never matches.
4. All of it is in one table, `inet rosrv_protect`, replaced in one transaction; rules of others are not
   touched, and nothing that they refuse is opened.
"""

import ipaddress
import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from appliance.network.firewall.firewall_rules import PortRange
from appliance.network.namespaces import NetworkError
from appliance.network.patience import run

TABLE = "rosrv_protect"
RANGE_FILE = Path("/proc/sys/net/ipv4/ip_local_port_range")
# ESP in the kernel; ESP in user space, where strongSwan's TUN device has this name. join.sh looks for both.
_THROUGH_IPSEC = ("meta ipsec exists ", 'iifname "ipsec*" ')
_SYN = "tcp flags & (syn | ack) == syn"
_SERVICE = re.compile(r"(tcp|udp)/(\d{1,5})(?:-(\d{1,5}))?")


@dataclass(frozen=True)
class Service:
    """Ports that stay open to everyone."""

    protocol: Literal["tcp", "udp"]
    ports: PortRange

    def __str__(self) -> str:
        return f"{self.protocol}/{self.ports}"


def parse_services(texts: Sequence[str]) -> tuple[Service, ...]:
    """Read services written as `tcp/22,udp/123,tcp/8000-8010`, in any number of texts.

    Raises: ValueError, naming the one that is wrong.
    """
    return tuple(_service(part.strip()) for text in texts for part in text.split(","))


def parse_ports(text: str) -> PortRange:
    """Read a range of ports written as `32768-60999` (or as one number)."""
    first, _, last = text.partition("-")
    if not (first.isdecimal() and (last or first).isdecimal()):
        raise ValueError(f"{text!r} is no range of ports such as 32768-60999")
    return PortRange(int(first), int(last or first))


def parse_address(text: str) -> str:
    """Read the address of an appliance; networks and names are not accepted."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        raise ValueError(
            f"{text!r} is no IP address of an appliance, such as 192.168.1.20 or fd00::20"
        ) from None
    if address.is_unspecified or address.is_multicast or address.is_loopback:
        raise ValueError(f"{text} cannot be the address of an appliance as other machines see it")
    return str(address)


def local_port_range() -> PortRange:
    """Return the ports that this machine's kernel picks from, the one range for IPv4 and IPv6."""
    try:
        first, last = RANGE_FILE.read_text(encoding="ascii").split()
    except (OSError, ValueError) as error:
        raise NetworkError(f"{RANGE_FILE}: {error}; name the range: --ports 32768-60999") from error
    return PortRange(int(first), int(last))


def protection(
    appliances: Sequence[str], ports: PortRange, services: Sequence[Service], *, tunnelled: bool = False
) -> str:
    """Return the nftables file that closes `ports` to all but loopback and the appliances.

    `tunnelled`: the appliances' addresses count only when a packet came through IPsec, which a stranger on the wire
    cannot forge. There are two rules then, for ESP in the kernel and for ESP in user space; the one that the
    machine does not need can never be right there, and may be taken out.
    """
    if not appliances:
        raise ValueError("the address of at least one appliance is needed")
    rules, leaving = ['iifname "lo" accept'], []
    for keyword, version in (("ip", 4), ("ip6", 6)):
        found = [text for text in appliances if ipaddress.ip_address(text).version == version]
        if found:
            addresses = f"{{ {', '.join(sorted(set(found)))} }}"
            source = f"{keyword} saddr {addresses} accept"
            rules += [f"{through}{source}" for through in (_THROUGH_IPSEC if tunnelled else ("",))]
            leaving.append(f"{keyword} daddr {addresses} {_SYN} iif != 0 fib saddr type local counter drop")
    rules += [f"{service.protocol} dport {service.ports} accept" for service in dict.fromkeys(services)]
    rules += [
        f"tcp dport {ports} {_SYN} counter reject with tcp reset",
        f"udp dport {ports} ct state {{ new, invalid }} counter drop",
    ]
    return (
        "#!/usr/sbin/nft -f\n"
        f"# Closes the ROS ports of this machine ({ports}) to all but loopback and the appliance\n"
        f"# ({', '.join(appliances)}), which nobody behind this machine reaches under its address.\n"
        "# Made by `rosrv protect`; `rosrv protect --remove` takes it away.\n"
        f"table inet {TABLE}\n"
        f"delete table inet {TABLE}\n"
        f"table inet {TABLE} {{\n"
        "    chain input {\n"
        "        type filter hook input priority filter; policy accept;\n"
        f"{_indented(rules)}"
        "    }\n"
        "    chain leaving {\n"
        "        type filter hook postrouting priority 300; policy accept;\n"
        f"{_indented(leaving)}"
        "    }\n"
        "}\n"
    )


def _indented(rules: Sequence[str]) -> str:
    return "".join(f"        {rule}\n" for rule in rules)


def apply(text: str) -> None:
    """Put a file of `protection` in force on this machine, in the place of an earlier one."""
    _nft(["-f", "-"], text)


def remove() -> None:
    """Take the protection away; none there is fine."""
    _nft(["-f", "-"], f"table inet {TABLE}\ndelete table inet {TABLE}\n")


def is_applied() -> bool:
    """Tell whether a protection is in force on this machine."""
    return f"table inet {TABLE}" in _nft(["list", "tables"], "").splitlines()


def _service(text: str) -> Service:
    found = _SERVICE.fullmatch(text)
    try:
        if found is None:
            raise ValueError("write tcp/22, udp/123 or tcp/8000-8010")
        protocol: Literal["tcp", "udp"] = "tcp" if found[1] == "tcp" else "udp"
        return Service(protocol, PortRange(int(found[2]), int(found[3] or found[2])))
    except ValueError as error:
        raise ValueError(f"--open {text!r} is no service: {error}") from None


def _nft(arguments: list[str], text: str) -> str:
    try:
        status, said, complaint = run(partial(subprocess.Popen, ["nft", *arguments]), text, "nft")
    except FileNotFoundError:
        raise NetworkError("the program `nft` is not here: sudo apt install nftables") from None
    except TimeoutError as error:
        raise NetworkError(str(error)) from None
    if status != 0:
        reason = " ".join(complaint.split())[:400]
        hint = " (run it as root: sudo rosrv protect …)" if "not permitted" in reason else ""
        raise NetworkError(f"nft: {reason}{hint}")
    return said
