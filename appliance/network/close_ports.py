"""Close the ROS ports of the machine that the nodes run on, with an nftables file.

1. A TCP connection is refused at its SYN, without the connection tracker, so connections that the machine itself
   opens continue. A UDP packet is dropped if it is new to the tracker, so answers pass.
2. A connection that this machine forwards to the appliance is dropped if it then has an address of this machine:
   the policy would treat it as the machine's own. With kernels before Linux 5.7 the rule never matches.
3. With `LocalCallers`, a connection from this machine to itself is refused at its SYN unless the connecting socket
   belongs to one of them. A packet without a socket has no owner, so it is refused.

On a host with a tunnel, a table of its own drops every packet from or to the appliance's tunnel address that does not
go through IPsec, even if no tunnel is open, and whatever `rosrv protect` does to the other table.
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
from appliance.network.hang_detection import run_program
from appliance.network.namespaces import NetworkError

TABLE = "rosrv_protect"
LINK = "veth-rosrv"
"""The interface of this machine that leads to its own appliance, whose address each start chooses (`isolation.py`)."""

TUNNEL_TABLE = "rosrv_tunnel"
RANGE_FILE = Path("/proc/sys/net/ipv4/ip_local_port_range")
# Not through IPsec, arriving and leaving. The first pair is for ESP in the kernel, the other for ESP in user space on
# strongSwan's TUN device: join.sh deletes the pair that does not apply.
_IN_CLEAR_TEXT = (("meta ipsec missing", 'iifname != "ipsec*"'), ("rt ipsec missing", 'oifname != "ipsec*"'))
_SYN = "tcp flags & (syn | ack) == syn"
_USER = re.compile(r"[a-z_][a-z0-9_-]{0,31}|[0-9]{1,10}")
_GROUP_NAME = re.compile(r"[\w.@:-]{1,255}", re.ASCII)
_SERVICE = re.compile(r"(tcp|udp)/(\d{1,5})(?:-(\d{1,5}))?")


@dataclass(frozen=True)
class OpenService:
    """A service whose ports stay open to all hosts."""

    protocol: Literal["tcp", "udp"]
    ports: PortRange

    def __str__(self) -> str:
        return f"{self.protocol}/{self.ports}"


@dataclass(frozen=True)
class LocalCallers:
    """The users (names or numbers) and control groups (paths below the root) that may reach the ports over loopback."""

    users: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.users and not self.groups:
            raise ValueError("--strict needs the user or the control group of the nodes: --user robot")
        for user in self.users:
            if not _USER.fullmatch(user):
                raise ValueError(f"--user {user!r} is not the name or the number of a user")
        for group in self.groups:
            if not all(map(_GROUP_NAME.fullmatch, group.split("/"))):
                raise ValueError(
                    f"--cgroup {group!r} is not the path of a control group, such as system.slice/robot.service"
                )

    def __str__(self) -> str:
        return ", ".join((*self.users, *self.groups))

    def rules(self) -> list[str]:
        """Return the rules of nftables that accept them."""
        users = [f"meta skuid {{ {', '.join(dict.fromkeys(self.users))} }} accept"] if self.users else []
        return users + [
            f'socket cgroupv2 level {group.count("/") + 1} "{group}" accept'
            for group in dict.fromkeys(self.groups)
        ]


def parse_services(texts: Sequence[str]) -> tuple[OpenService, ...]:
    """Return the services in the texts. Raises `ValueError` with the invalid one."""
    return tuple(_service(part.strip()) for text in texts for part in text.split(","))


def parse_ports(text: str) -> PortRange:
    first, _, last = text.partition("-")
    if not (first.isdecimal() and (last or first).isdecimal()):
        raise ValueError(f"{text!r} is not a range of ports such as 32768-60999")
    return PortRange(int(first), int(last or first))


def parse_address(text: str) -> str:
    """Return the IP address of an appliance. Raises `ValueError` for a network or a name."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        raise ValueError(
            f"{text!r} is not the IP address of an appliance, such as 192.168.1.20 or fd00::20"
        ) from None
    if address.is_unspecified or address.is_multicast or address.is_loopback:
        raise ValueError(f"{text} cannot be the address of an appliance as other machines see it")
    return str(address)


def local_port_range() -> PortRange:
    try:
        first, last = RANGE_FILE.read_text(encoding="ascii").split()
    except (OSError, ValueError) as error:
        raise NetworkError(f"{RANGE_FILE}: {error}; name the range: --ports 32768-60999") from error
    return PortRange(int(first), int(last))


def protection(
    appliances: Sequence[str],
    ports: PortRange,
    services: Sequence[OpenService],
    *,
    strict: LocalCallers | None = None,
) -> str:
    """Return the nftables file for appliances with these addresses, or behind `LINK`.

    `strict`: only these programs of the machine itself reach the ports.
    """
    if not appliances:
        raise ValueError("give the address of at least one appliance")
    addresses = sorted({*appliances} - {LINK})
    ends = [(f'iifname "{LINK}"', f'oifname "{LINK}"')] if LINK in appliances else []
    for keyword, version in (("ip", 4), ("ip6", 6)):
        found = [text for text in addresses if ipaddress.ip_address(text).version == version]
        if found:
            named = f"{{ {', '.join(found)} }}"
            ends.append((f"{keyword} saddr {named}", f"{keyword} daddr {named}"))
    rules = ['iifname "lo" accept', *(f"{arriving} accept" for arriving, _leaving in ends)]
    leaving = [f"{end} {_SYN} iif != 0 fib saddr type local counter drop" for _arriving, end in ends]
    opened = [f"{service.protocol} dport {service.ports} accept" for service in dict.fromkeys(services)]
    local = (
        []
        if strict is None
        else [
            'oifname != "lo" accept',
            *opened,
            *strict.rules(),
            f"tcp dport {ports} {_SYN} counter reject with tcp reset",
            f"udp dport {ports} ct state {{ new, invalid }} counter drop",
        ]
    )
    rules += opened
    rules += [
        f"tcp dport {ports} {_SYN} counter reject with tcp reset",
        f"udp dport {ports} ct state {{ new, invalid }} counter drop",
    ]
    free = f"# Open to all: {', '.join(map(str, dict.fromkeys(services)))}.\n" if services else ""
    inside = "loopback" if strict is None else f"{strict} of this machine"
    head = "    chain local {\n        type filter hook output priority filter; policy accept;\n"
    chain = f"{head}{_indent(local)}    }}\n" if local else ""
    return (
        "#!/usr/sbin/nft -f\n"
        f"# Closes the ROS ports of this machine ({ports}) to all but {inside} and the appliance\n"
        f"# ({', '.join(appliances)}), whose address no host behind this machine can use.\n"
        f"{free}"
        "# Made by `rosrv protect`; `rosrv protect --remove` removes it.\n"
        f"table inet {TABLE}\n"
        f"delete table inet {TABLE}\n"
        f"table inet {TABLE} {{\n"
        "    chain input {\n"
        "        type filter hook input priority filter; policy accept;\n"
        f"{_indent(rules)}"
        "    }\n"
        "    chain leaving {\n"
        "        type filter hook postrouting priority 300; policy accept;\n"
        f"{_indent(leaving)}"
        "    }\n"
        f"{chain}"
        "}\n"
    )


def through_tunnel_only(appliance: str) -> str:
    """Return the nftables file of a host with a tunnel: what this address sends or gets in clear text is dropped.

    Its hooks see every packet with its address on the wire, even one that this machine forwards.
    """
    keyword = "ip" if ipaddress.ip_address(appliance).version == 4 else "ip6"
    arriving, leaving = (
        _indent([f"{outside} {keyword} {end} {appliance} counter drop" for outside in either])
        for either, end in zip(_IN_CLEAR_TEXT, ("saddr", "daddr"), strict=True)
    )
    return (
        f"# Keeps {appliance}, the appliance's address in the tunnel, for the tunnel.\n"
        f"table inet {TUNNEL_TABLE}\n"
        f"delete table inet {TUNNEL_TABLE}\n"
        f"table inet {TUNNEL_TABLE} {{\n"
        "    chain arriving {\n"
        "        type filter hook prerouting priority filter; policy accept;\n"
        f"{arriving}"
        "    }\n"
        "    chain leaving {\n"
        "        type filter hook postrouting priority 300; policy accept;\n"
        f"{leaving}"
        "    }\n"
        "}\n"
    )


def _indent(rules: Sequence[str]) -> str:
    return "".join(f"        {rule}\n" for rule in rules)


def apply(text: str) -> None:
    _nft(["-f", "-"], text)


def remove() -> None:
    _nft(["-f", "-"], f"table inet {TABLE}\ndelete table inet {TABLE}\n")


def is_applied(table: str = TABLE) -> bool:
    return f"table inet {table}" in _nft(["list", "tables"], "").splitlines()


def applied_rules() -> str:
    """Return the rules that are in force, as text for `nft -f`; empty without any. Raises `NetworkError`."""
    return _nft(["-s", "list", "table", "inet", TABLE], "") if is_applied() else ""


def _service(text: str) -> OpenService:
    match = _SERVICE.fullmatch(text)
    try:
        if match is None:
            raise ValueError("write tcp/22, udp/123 or tcp/8000-8010")
        protocol: Literal["tcp", "udp"] = "tcp" if match[1] == "tcp" else "udp"
        return OpenService(protocol, PortRange(int(match[2]), int(match[3] or match[2])))
    except ValueError as error:
        raise ValueError(f"--open {text!r} is not a service: {error}") from None


def _nft(arguments: list[str], text: str) -> str:
    try:
        status, said, complaint = run_program(partial(subprocess.Popen, ["nft", *arguments]), text, "nft")
    except FileNotFoundError:
        raise NetworkError("the program `nft` is missing: sudo apt install nftables") from None
    except TimeoutError as error:
        raise NetworkError(str(error)) from None
    if status != 0:
        reason = " ".join(complaint.split())[:400]
        hint = " (run it as root: sudo rosrv protect …)" if "not permitted" in reason else ""
        raise NetworkError(f"nft: {reason}{hint}")
    return said
