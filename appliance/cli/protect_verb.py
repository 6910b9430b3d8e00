"""`rosrv protect`: close the ROS ports of the machine the nodes run on, and check from outside that they are.

It needs no state directory, so it runs on any machine that has this program; where an appliance is named, its address
is asked for, and what a check saw is told to it. Exit status: 0 done, or closed; 1 a port is open; 2 it could not be
done, or nothing answered.
"""

import json
import sys
import time
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal, NoReturn
from urllib.parse import urlsplit

import typer

from appliance.channel.admin import HostPorts, StatusWanted
from appliance.cli.admin_client import NotRunningError
from appliance.cli.target import Appliance, speaks
from appliance.network import close_ports as protection
from appliance.network.firewall.firewall_rules import PortRange
from appliance.network.namespaces import Namespace, NetworkError
from appliance.network.scan import ScanResult, addresses_of, scan

OPEN_STATUS, ERROR_STATUS = 1, 2
_SHOWN = 20  # open ports named on a terminal
_MOST_TOLD = 100

HELP = """Nodes listen on ports of the local port range. Without a verb the nftables file is only printed.

\b
  rosrv protect --appliance 192.168.1.20                    look at it
  rosrv protect --state /var/lib/rosrv                      the appliance that runs on this machine
  sudo rosrv protect --appliance 192.168.1.20 --open tcp/40022 --apply
  rosrv protect --check 192.168.1.10                        on ANOTHER machine: is it closed?
  rosrv protect --check 192.168.1.10 --api https://192.168.1.20:8443      and tell the appliance (role operator)
  sudo rosrv protect --remove

\b
It holds until the next boot. To keep it, install the file:
  rosrv protect --appliance 192.168.1.20 | sudo tee /etc/rosrv-protect.nft
  echo 'include "/etc/rosrv-protect.nft"' | sudo tee -a /etc/nftables.conf
  sudo systemctl enable --now nftables

The check tries TCP. Run it from a machine that is not the appliance: the appliance is let in.
"""


@speaks
def protect(
    running: Appliance,
    *,
    appliance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ADDRESS",
            help="Address of the appliance, as this machine sees it (default: the one at --state). Repeatable.",
        ),
    ] = None,
    open_services: Annotated[
        list[str] | None,
        typer.Option("--open", metavar="SERVICES", help="Stays open to all: tcp/22,udp/123. Repeatable."),
    ] = None,
    ports: Annotated[
        str | None,
        typer.Option(
            metavar="FIRST-LAST", help="The ports to close (default: this machine's local port range)."
        ),
    ] = None,
    apply: Annotated[
        bool, typer.Option("--apply", help="Put it in force now, replacing an earlier one.")
    ] = False,
    check: Annotated[
        str | None, typer.Option(metavar="HOST", help="Try the ports of another machine from here.")
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(
            "--as", metavar="NAME", help="Check: the machine's name as an enrolled host, to be told."
        ),
    ] = None,
    remove: Annotated[bool, typer.Option("--remove", help="Take it away.")] = False,
    seconds: Annotated[
        float, typer.Option(min=0.05, max=60, help="Check: how long to wait for an answer of each port.")
    ] = 1.0,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Dispatch on the verb; see HELP."""
    if sum((apply, check is not None, remove)) > 1:
        _fail("--apply, --check and --remove exclude one another")
    try:
        services = protection.parse_services(open_services or ())
        chosen = protection.parse_ports(ports) if ports is not None else protection.local_port_range()
        if check is not None:
            _check(_Checked(check, name, chosen, services, seconds), running, as_json)
        elif remove:
            _remove(as_json)
        else:
            _make(appliance or [_own(running)], chosen, services, apply, as_json)
    except (ValueError, NetworkError) as error:
        _fail(str(error))


protect.__doc__ = HELP


def _make(
    appliances: list[str],
    ports: PortRange,
    services: tuple[protection.Service, ...],
    apply: bool,
    as_json: bool,
) -> None:
    text = protection.protection(
        [protection.parse_address(appliance) for appliance in appliances], ports, services
    )
    for service in services:
        if service.ports.last < ports.first or service.ports.first > ports.last:
            sys.stderr.write(f"rosrv: note: {service} is outside {ports} and open in any case\n")
    if apply:
        protection.apply(text)
        if Namespace.own().lacks_syn_cookies():
            sys.stderr.write(
                "rosrv: warning: net.ipv4.tcp_syncookies is 0 on this machine: whoever forges first packets under the"
                " appliance's address keeps it out. sysctl -w net.ipv4.tcp_syncookies=1\n"
            )
        _say(
            as_json,
            {"event": "applied", "ports": str(ports), "appliances": appliances},
            f"TCP and UDP {ports} are now closed to all but loopback and {', '.join(appliances)}.\n"
            "Check it from another machine: rosrv protect --check ADDRESS-OF-THIS-MACHINE\n",
        )
    else:
        _say(as_json, {"event": "file", "ports": str(ports), "appliances": appliances, "text": text}, text)


def _remove(as_json: bool) -> None:
    was = protection.is_applied()
    protection.remove()
    words = "The ROS ports of this machine are open again.\n" if was else "There was nothing to remove.\n"
    _say(as_json, {"event": "removed", "was_applied": was}, words)


@dataclass(frozen=True)
class _Checked:
    """What is tried, under which name it is told; a None is the address that was tried."""

    host: str
    name: str | None
    ports: PortRange
    services: tuple[protection.Service, ...]
    seconds: float

    def wanted(self) -> list[int]:
        """The TCP ports that are to be closed."""
        stay_open = {
            port
            for service in self.services
            if service.protocol == "tcp"
            for port in range(service.ports.first, service.ports.last + 1)
        }
        return [port for port in range(self.ports.first, self.ports.last + 1) if port not in stay_open]


def _check(checked: _Checked, running: Appliance, as_json: bool) -> None:
    results = [scan(address, checked.wanted(), checked.seconds) for address in addresses_of(checked.host)]
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
    _say(as_json, report, "".join(_sentence(result, checked.ports) for result in results))
    if running.said:
        found = sorted({port for result in results for port in result.open})[:_MOST_TOLD]
        name = checked.name or results[0].address
        body = running.ask_or_exit(HostPorts(name, state, found, time.time()))
        sys.stderr.write(f"rosrv: the appliance knows it: the ports of {body.name} are {state}\n")
    if opened:
        raise typer.Exit(OPEN_STATUS)
    if unknown:
        raise typer.Exit(ERROR_STATUS)


def _own(running: Appliance) -> str:
    """The address of the appliance that runs on this machine. Raises `ValueError`."""
    hint = "give its address as this machine sees it: --appliance 192.168.1.20"
    if running.place is not None:
        raise ValueError(f"how this machine sees the appliance is not known over REST; {hint}")
    try:
        answer = running.ask(StatusWanted())
    except NotRunningError as error:
        raise ValueError(f"which appliance may reach this machine? {error}; or {hint}") from None
    if not answer.ok:
        raise ValueError(f"{answer.error}; {hint}")
    if answer.given().isolation == "none":
        raise ValueError(f"the appliance runs on this machine without isolation, as loopback; {hint}")
    return str(urlsplit(answer.given().master).hostname)


def _sentence(result: ScanResult, ports: PortRange) -> str:
    if result.open:
        named = ", ".join(str(port) for port in result.open[:_SHOWN])
        more = f" and {len(result.open) - _SHOWN} more" if len(result.open) > _SHOWN else ""
        return f"{result.address}: OPEN: TCP {named}{more} of {ports}\n"
    if result.untried:
        return (
            f"{result.address}: {result.untried} ports of {ports} could not be tried: {result.obstacle}; whether they "
            "are closed is not known. Does this machine have a route there (ip route get)?\n"
        )
    if not result.answered:
        return (
            f"{result.address}: no port of {ports} answered: the machine is off, or drops what it refuses; "
            "that it is closed is not known\n"
        )
    return f"{result.address}: closed: no port of {ports} accepts a connection from here\n"


def _say(as_json: bool, report: dict[str, Any], words: str) -> None:
    sys.stdout.write(json.dumps(report) + "\n" if as_json else words)


def _fail(message: str) -> NoReturn:
    sys.stderr.write(f"rosrv: {message}\n")
    raise typer.Exit(ERROR_STATUS)
