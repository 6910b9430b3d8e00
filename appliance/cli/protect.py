"""`rosrv protect`: close the ROS ports of the machine the nodes run on, and check from outside that they are.

It reads and writes no state directory, so it runs on any machine that has this program. Exit status: 0 done,
or closed; 1 a port is open; 2 it could not be done, or nothing answered.
"""

import json
import sys
from typing import Annotated, Any, NoReturn

import typer

from appliance.network import protect as protection
from appliance.network.firewall.rules import PortRange
from appliance.network.namespaces import NetworkError
from appliance.network.scan import ScanResult, addresses_of, scan

OPEN_STATUS, ERROR_STATUS = 1, 2
_SHOWN = 20  # open ports named on a terminal

HELP = """Close the ROS ports of this machine to all but the appliance.

Nodes listen on ports of the local port range. Without a verb the nftables file is only printed.

\b
  rosrv protect --appliance 192.168.1.20                    look at it
  sudo rosrv protect --appliance 192.168.1.20 --open tcp/40022 --apply
  rosrv protect --check 192.168.1.10                        on ANOTHER machine: is it closed?
  sudo rosrv protect --remove

\b
It holds until the next boot. To keep it, install the file:
  rosrv protect --appliance 192.168.1.20 | sudo tee /etc/rosrv-protect.nft
  echo 'include "/etc/rosrv-protect.nft"' | sudo tee -a /etc/nftables.conf
  sudo systemctl enable --now nftables

The check tries TCP. Run it from a machine that is not the appliance: the appliance is let in.
"""


def protect(
    *,
    appliance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ADDRESS", help="Address of the appliance, as this machine sees it. Repeatable."
        ),
    ] = None,
    open_services: Annotated[
        list[str] | None,
        typer.Option("--open", metavar="SERVICES", help="Stays open to all: tcp/22,udp/123. Repeatable."),
    ] = None,
    ports: Annotated[
        str | None,
        typer.Option(
            metavar="FIRST-LAST", help="The ports to close. [default: this machine's local port range]"
        ),
    ] = None,
    apply: Annotated[
        bool, typer.Option("--apply", help="Put it in force now, replacing an earlier one.")
    ] = False,
    check: Annotated[
        str | None, typer.Option(metavar="HOST", help="Try the ports of another machine from here.")
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
            _check(check, chosen, services, seconds, as_json)
        elif remove:
            _remove(as_json)
        else:
            _make(appliance or [], chosen, services, apply, as_json)
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
    if not appliances:
        raise ValueError(
            "which appliance may reach this machine? Give its address as this machine sees it: "
            "--appliance 192.168.1.20 (`rosrv status` on the appliance shows it)"
        )
    text = protection.protection([protection.parse_address(one) for one in appliances], ports, services)
    for service in services:
        if service.ports.last < ports.first or service.ports.first > ports.last:
            sys.stderr.write(f"rosrv: note: {service} is outside {ports} and open in any case\n")
    if apply:
        protection.apply(text)
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


def _check(
    host: str, ports: PortRange, services: tuple[protection.Service, ...], seconds: float, as_json: bool
) -> None:
    stay_open = {
        port
        for service in services
        if service.protocol == "tcp"
        for port in range(service.ports.first, service.ports.last + 1)
    }
    wanted = [port for port in range(ports.first, ports.last + 1) if port not in stay_open]
    results = [scan(address, wanted, seconds) for address in addresses_of(host)]
    opened = any(result.open for result in results)
    unknown = not all(result.answered for result in results)
    state = "open" if opened else "unknown" if unknown else "closed"
    addresses = [
        {"address": one.address, "open": one.open, "refused": one.refused, "silent": one.silent}
        for one in results
    ]
    report = {"event": "check", "host": host, "ports": str(ports), "state": state, "addresses": addresses}
    _say(as_json, report, "".join(_sentence(result, ports) for result in results))
    if opened:
        raise typer.Exit(OPEN_STATUS)
    if unknown:
        raise typer.Exit(ERROR_STATUS)


def _sentence(result: ScanResult, ports: PortRange) -> str:
    if result.open:
        named = ", ".join(str(port) for port in result.open[:_SHOWN])
        more = f" and {len(result.open) - _SHOWN} more" if len(result.open) > _SHOWN else ""
        return f"{result.address}: OPEN: TCP {named}{more} of {ports}\n"
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
