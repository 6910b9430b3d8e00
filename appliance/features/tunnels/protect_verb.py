"""The command `rosrv protect`.

Exit status: 0 done, or closed; 1 a port is open; 2 failed, no answer, or closed but not reported.
"""

import json
import sys
from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass
from ipaddress import ip_address, ip_interface
from typing import Annotated, Any, Literal, NoReturn
from urllib.parse import urlsplit

import typer

from appliance.base import clock
from appliance.base.counted import counted
from appliance.channel.admin import StatusWanted
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance, speaks_with
from appliance.cli.durations import bounded_span
from appliance.features.tunnels.requests import HostPorts
from appliance.network import close_ports as protection
from appliance.network import scan as scanner
from appliance.network.firewall.firewall_rules import PortRange
from appliance.network.interfaces import addresses_by_interface
from appliance.network.namespaces import Namespace, NetworkError
from appliance.network.scan import ScanResult, addresses_of
from rosmop.tool.terminal import printable

OPEN_STATUS, ERROR_STATUS = 1, 2
_SHOWN = 20  # most open ports listed on a terminal
_MAX_TOLD = 100
_UNANNOUNCED_SECONDS = 5.0


_Appliances = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ADDRESS",
        help="Address of the appliance, as this machine sees it (default: the one at --state; repeatable)",
    ),
]
_OpenServices = Annotated[
    list[str] | None,
    typer.Option("--open", metavar="SERVICES", help="Keep open to all: tcp/22,udp/123 (repeatable)"),
]
_Ports = Annotated[
    str | None,
    typer.Option(
        metavar="FIRST-LAST",
        help="The ports to close or check (default: the local port range here, of this machine or container)",
    ),
]
_Strict = Annotated[
    bool,
    typer.Option(
        "--strict",
        help="Close the ports also to programs of this machine, except those of --user and --cgroup",
    ),
]
_Users = Annotated[
    list[str] | None,
    typer.Option("--user", metavar="USER", help="With --strict: a user that runs nodes (repeatable)"),
]
_ControlGroups = Annotated[
    list[str] | None,
    typer.Option(
        "--cgroup",
        metavar="PATH",
        help="With --strict: a control group of nodes, such as system.slice/robot.service (repeatable)",
    ),
]
_Apply = Annotated[bool, typer.Option("--apply", help="Apply the rules now, replacing earlier ones")]
_Checked = Annotated[
    str | None, typer.Option(metavar="HOST", help="Try the ports of another machine from here")
]
_HostName = Annotated[
    str | None,
    typer.Option(
        "--as", metavar="NAME", help="With --check: report the result for the enrolled host of this name"
    ),
]
_Remove = Annotated[bool, typer.Option("--remove", help="Remove the rules")]
_Within = Annotated[str, typer.Option(help="With --check: the longest wait for each port, 0.05s to 1m")]


@speaks_with("One JSON object")
def protect(
    running: Appliance,
    *,
    appliance: _Appliances = None,
    open_services: _OpenServices = None,
    ports: _Ports = None,
    strict: _Strict = False,
    users: _Users = None,
    groups: _ControlGroups = None,
    apply: _Apply = False,
    check: _Checked = None,
    name: _HostName = None,
    remove: _Remove = False,
    within: _Within = "1s",
) -> None:
    """Nodes listen on ports of the local port range. Without --apply, --check or --remove, print the nftables rules.

    \b
    Print the rules, for an appliance elsewhere or on this machine:
      rosrv protect --appliance 192.168.1.20
      rosrv protect --state /var/lib/rosrv
    Close the ports, and open them again:
      sudo rosrv protect --appliance 192.168.1.20 --open tcp/40022 --apply
      sudo rosrv protect --remove
    Close them also to other users of this machine:
      sudo rosrv protect --appliance 192.168.1.20 --strict --user robot --apply
    Check another machine, and report to the appliance (role operator):
      rosrv protect --check 192.168.1.10
      rosrv protect --check 192.168.1.10 --api https://192.168.1.20:8443

    The rules last until the next boot; docs/close-the-ports.md has a systemd unit that keeps them.

    The check tries TCP. Run it on a machine other than the appliance's, because the rules let the appliance in. Exit
    status: 0 done, or closed; 1 a port is open; 2 failed, no answer, or closed but not reported.
    """
    seconds = bounded_span("--within", within, "0.05s", "1m", "rosrv protect")
    if sum((apply, check is not None, remove)) > 1:
        _fail("--apply, --check and --remove exclude one another: give one")
    try:
        services = protection.parse_services(open_services or ())
        chosen = protection.parse_ports(ports) if ports is not None else protection.local_port_range()
        local = _local_callers(users or (), groups or (), strict=strict)
        if check is not None:
            _check(_CheckTarget(check, name, chosen, services, seconds), running)
        elif remove:
            _remove(running.as_json)
        else:
            _make(appliance or [_own(running)], chosen, services, local, apply=apply, as_json=running.as_json)
            if ports is None and not apply:
                _note_default(chosen)
    except (ValueError, NetworkError) as error:
        _fail(str(error))


def _local_callers(
    users: Collection[str], groups: Collection[str], *, strict: bool
) -> protection.LocalCallers | None:
    if (users or groups) and not strict:
        _fail("--user and --cgroup need --strict")
    return protection.LocalCallers(tuple(users), tuple(groups)) if strict else None


def _note_default(ports: PortRange) -> None:
    sys.stderr.write(
        f"rosrv: note: {ports} is the local port range here; for another machine, or the machine of this"
        " container, give its own: --ports\n"
    )


def _make(
    appliances: list[str],
    ports: PortRange,
    services: tuple[protection.OpenService, ...],
    local: protection.LocalCallers | None,
    *,
    apply: bool,
    as_json: bool,
) -> None:
    text = protection.protection(
        _named(map(protection.parse_address, appliances)), ports, services, strict=local
    )
    for service in services:
        if service.ports.last < ports.first or service.ports.first > ports.last:
            sys.stderr.write(f"rosrv: note: {service} is outside {ports} and open in any case\n")
    if apply:
        protection.apply(text)
        if Namespace.own().lacks_syn_cookies():
            sys.stderr.write(
                "rosrv: warning: net.ipv4.tcp_syncookies is 0 on this machine: forged SYN packets from the appliance's"
                " address can lock the appliance out. Run: sysctl -w net.ipv4.tcp_syncookies=1\n"
            )
        inside = "loopback" if local is None else f"{local} on this machine"
        opened = [*map(str, services)]
        _say(
            as_json,
            {
                "event": "applied",
                "ports": str(ports),
                "appliances": appliances,
                "strict": local is not None,
                "open": opened,
            },
            f"TCP and UDP {ports} are now closed to all but {inside} and {', '.join(appliances)}"
            f"{'; open to all: ' if opened else ''}{', '.join(opened)}.\n"
            "Check it from another machine: rosrv protect --check ADDRESS-OF-THIS-MACHINE\n",
        )
    else:
        _say(as_json, {"event": "file", "ports": str(ports), "appliances": appliances, "text": text}, text)


def _named(appliances: Iterable[str]) -> list[str]:
    """Return the addresses, and the link for one on this machine, whose address may change at a start."""
    held = addresses_by_interface(Namespace.own()).get(protection.LINK, [])
    near = [ip_interface(text).network for text in held]
    named = (
        protection.LINK if any(ip_address(one) in network for network in near) else one for one in appliances
    )
    return [*dict.fromkeys(named)]


def _remove(as_json: bool) -> None:
    was = protection.is_applied()
    protection.remove()
    words = "The ROS ports of this machine are open again.\n" if was else "There was nothing to remove.\n"
    if protection.is_applied(protection.TUNNEL_TABLE):
        words = (
            "The kit of this machine's tunnel closes the ROS ports again within 15 s. To open them, leave the tunnel:"
            " sudo /etc/rosrv/leave.sh\n"
        )
    _say(as_json, {"event": "removed", "was_applied": was}, words)


@dataclass(frozen=True)
class _CheckTarget:
    """The machine to check. The report has `name`, or else the address."""

    host: str
    name: str | None
    ports: PortRange
    services: tuple[protection.OpenService, ...]
    seconds: float

    def ports_to_check(self) -> list[int]:
        stay_open = {
            port
            for service in self.services
            if service.protocol == "tcp"
            for port in range(service.ports.first, service.ports.last + 1)
        }
        return [port for port in range(self.ports.first, self.ports.last + 1) if port not in stay_open]


def _check(checked: _CheckTarget, running: Appliance) -> None:
    wanted, found_addresses = checked.ports_to_check(), addresses_of(checked.host)
    longest = scanner.longest(len(wanted), checked.seconds) * len(found_addresses)
    if longest > _UNANNOUNCED_SECONDS:
        sys.stderr.write(
            f"rosrv: trying {counted(len(wanted), 'port')} of {printable(checked.host)}: up to {longest:.0f} s"
            " if it does not"
            " answer\n"
        )
    results = [scanner.scan(address, wanted, checked.seconds) for address in found_addresses]
    opened = any(result.open for result in results)
    unknown = not all(result.answered and not result.untried for result in results)
    state: Literal["closed", "open", "unknown"] = "open" if opened else "unknown" if unknown else "closed"
    addresses = [asdict(result) | {"obstacle": result.obstacle or None} for result in results]
    report = {
        "event": "check",
        "host": checked.host,
        "ports": str(checked.ports),
        "state": state,
        "addresses": addresses,
    }
    _say(running.as_json, report, "".join(_sentence(result, checked.ports) for result in results))
    found = sorted({port for result in results for port in result.open})[:_MAX_TOLD]
    result = HostPorts(checked.name or results[0].address, state, found, clock.wall())
    reported = not running.said or _report(running, result)
    if opened:
        raise typer.Exit(OPEN_STATUS)
    if unknown or not reported:
        raise typer.Exit(ERROR_STATUS)


def _report(running: Appliance, result: HostPorts) -> bool:
    """Report the result to the appliance, and print whether it was accepted."""
    try:
        answer = running.ask(result)
    except NotRunningError as error:
        trouble = str(error)
    else:
        trouble = "" if answer.ok else "; ".join((answer.error, *answer.findings))
    if trouble:
        sys.stderr.write(f"rosrv: the result was not reported: {printable(trouble)}\n")
    else:
        name = answer.unwrap().name or result.name
        sys.stderr.write(f"rosrv: reported to the appliance: the ports of {name} are {result.state}\n")
    return not trouble


def _own(running: Appliance) -> str:
    hint = "give its address as this machine sees it: --appliance 192.168.1.20"
    if running.place is not None:
        raise ValueError(f"REST does not know the appliance's address on this machine's network; {hint}")
    try:
        answer = running.ask(StatusWanted())
    except NotRunningError as error:
        raise ValueError(f"the appliance's address is unknown: {error}; or {hint}") from None
    if not answer.ok:
        raise ValueError(f"{answer.error}; {hint}")
    if answer.unwrap().isolation == "none":
        raise ValueError(
            f"the appliance on this machine has no isolation and only a loopback address; {hint}"
        )
    return str(urlsplit(answer.unwrap().master).hostname)


def _sentence(result: ScanResult, ports: PortRange) -> str:
    if result.open:
        named = ", ".join(str(port) for port in result.open[:_SHOWN])
        more = f" and {len(result.open) - _SHOWN} more" if len(result.open) > _SHOWN else ""
        return f"{result.address}: OPEN: TCP {named}{more} of {ports}\n"
    if result.untried:
        return (
            f"{result.address}: {counted(result.untried, 'port')} of {ports} could not be tried:"
            f" {result.obstacle}; they may be "
            "open. Check this machine's route there: ip route get\n"
        )
    if not result.answered:
        return (
            f"{result.address}: no port of {ports} answered: the machine is off, or drops packets silently; "
            "its ports may be open\n"
        )
    silent = f"; {counted(result.silent, 'port')} gave no answer at two attempts" if result.silent else ""
    return f"{result.address}: closed: no port of {ports} accepts a connection from here{silent}\n"


def _say(as_json: bool, report: dict[str, Any], words: str) -> None:
    sys.stdout.write(json.dumps(report) + "\n" if as_json else words)


def _fail(message: str) -> NoReturn:
    sys.stderr.write(f"rosrv: {message}\n")
    raise typer.Exit(ERROR_STATUS)
