"""The commands `rosrv host add|list|kit|reload|revoke`."""

from pathlib import Path
from typing import Annotated

import typer
from msgspec.structs import replace

from appliance.base.counted import counted
from appliance.base.validation_messages import meant
from appliance.channel.answers.host_answers import Host, PortsSeen
from appliance.cli import completion
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import bounded_span
from appliance.cli.output import moment, say_json, say_row
from appliance.features.tunnels.kit_output import (
    key_and_request,
    new_output,
    placed,
    usage_error,
    wishes_of,
    write_kit,
    write_script,
)
from appliance.features.tunnels.kits import KitOptions
from appliance.features.tunnels.requests import (
    HostAdd,
    HostList,
    HostRenew,
    HostRevoke,
    HostsReload,
    HostToken,
)
from appliance.network.close_ports import parse_services
from rosmop.tool.terminal import printable, say

_DAY = 86_400.0
_Name = Annotated[
    str,
    typer.Argument(
        help="Name of the host, `host:NAME` in the policy",
        show_default=False,
        autocompletion=completion.hosts,
    ),
]
_Endpoint = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Address or name at which the host reaches the appliance (UDP 500 and 4500; default: `ipsec.endpoint` of"
        " the configuration, else the machine's address towards its default route)",
    ),
]
_Csr = Annotated[
    Path | None,
    typer.Option(help="Signing request (PEM) for the host's own key; the kit then has no private key"),
]
_Valid = Annotated[str, typer.Option("--for", help="How long the certificate is valid: 90d, 52w")]
_Out = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        help="File to write; must not exist (default: rosrv-NAME.tar.gz; with --token rosrv-NAME-join.sh); - for"
        " standard output",
    ),
]
_Open = Annotated[
    list[str] | None,
    typer.Option("--open", metavar="SERVICES", help="Services of the host to keep open: tcp/22 (repeatable)"),
]
_Ports = Annotated[
    str, typer.Option(help="The host's local port range, where ROS nodes listen; the kit closes it")
]
_Within = Annotated[
    str | None,
    typer.Option(
        help="With --token: the longest wait until the host enrols: 30m, 1h or 7d (default: 1h)",
        show_default=False,
    ),
]


@speaks
def add(  # noqa: PLR0917  typer gives every flag by its name
    running: Appliance,
    name: _Name,
    appliance: _Endpoint = None,
    address: Annotated[
        str | None,
        typer.Option(help="Virtual address of the host in its tunnel (default: the next free one)"),
    ] = None,
    token: Annotated[
        bool,
        typer.Option(
            "--token", help="Print a one-time token and write a script; the host creates its own key"
        ),
    ] = False,
    within: _Within = None,
    csr: _Csr = None,
    valid: _Valid = "90d",
    out: _Out = None,
    opened: _Open = None,
    ports: _Ports = "32768-60999",
) -> None:
    """Enrol a host: write its kit, one archive with the files for its tunnel. With --token, print a token with which
    the host enrols itself.

    Example: rosrv host add ocu-1 --token
    """
    wishes, days = wishes_of(appliance, ports, opened), _days(valid)
    seconds = _token_seconds(within, csr, token=token)
    if token:
        order = HostToken(name, token_seconds=seconds, days=days, address=address, new=True)
        _write_script(running, order, wishes, out)
    else:
        _write_kit(running, HostAdd(name, "", days, address), csr, wishes, out)


@speaks
def kit(  # noqa: PLR0917  as above
    running: Appliance,
    name: _Name,
    appliance: _Endpoint = None,
    token: Annotated[
        bool, typer.Option("--token", help="Print a one-time token instead; the host creates a new key")
    ] = False,
    within: _Within = None,
    csr: _Csr = None,
    valid: _Valid = "90d",
    out: _Out = None,
    opened: _Open = None,
    ports: _Ports = "32768-60999",
) -> None:
    """Write a new kit for an enrolled host. Its old certificate is revoked and its tunnel closed; with --token, only
    when the host enrols.

    Example: rosrv host kit ocu-1
    """
    wishes, days = wishes_of(appliance, ports, opened), _days(valid)
    seconds = _token_seconds(within, csr, token=token)
    if token:
        order = HostToken(name, token_seconds=seconds, days=days)
        _write_script(running, order, wishes, out)
    else:
        _write_kit(running, HostRenew(name, "", days), csr, wishes, out)


@speaks
def list_hosts(
    running: Appliance,
    group: Annotated[str | None, typer.Option(help="Only hosts of this group of hosts.yaml")] = None,
) -> None:
    """List the hosts with their tunnels, and machines that connect in clear text.

    `awaited` is a host whose one-time token was not used yet; `not enrolled` is one that only hosts.yaml declares.

    Example: rosrv host list
    """
    body = running.ask_or_exit(HostList())
    groups = sorted({name for row in body.hosts for name in row.groups})
    if group is not None and group not in groups:
        known = meant(group, groups) or f": {', '.join(groups[:20]) or 'it has none'}"
        typer.echo(printable(f"rosrv: hosts.yaml has no group {group!r}{known}"), err=True)
    for row in body.hosts:
        if group is not None and group not in row.groups:
            continue
        if running.as_json:
            say_json(row)
        else:
            say_row(_words(row))
    if running.as_json or group is not None:
        return
    if not body.hosts:
        say("no hosts; enrol one: rosrv host add NAME")
    for machine in body.machines:
        nodes = f"{counted(machine.nodes, 'node')} in clear text"
        say_row([f"{running.host_in_words(machine.address):<37} {nodes:<13}", _ports_words(machine.ports)])
    for trouble in body.troubles:
        say(f"! {trouble}")


@speaks
def reload(running: Appliance) -> None:
    """Read hosts.yaml again and open or close tunnels as it declares. No host is enrolled or revoked.

    Example: rosrv host reload
    """
    body = running.answer_or_exit(HostsReload())
    change = "" if body.opened or body.closed else "; no tunnel was opened or closed"
    say(f"{counted(len(body.declared), 'host is', 'hosts are')} declared{change}")
    for word, names in (("tunnel allowed again", body.opened), ("tunnel closed", body.closed)):
        if names:
            say(f"{word}: {', '.join(names)}")
    for difference in body.divergence:
        say(f"! {difference}")


@speaks
def revoke(running: Appliance, name: _Name) -> None:
    """Revoke a host now: close its tunnel, remove its registrations and grants, and cancel its one-time token.

    Example: rosrv host revoke ocu-1
    """
    body = running.answer_or_exit(HostRevoke(name))
    if not body.serial:
        say(f"{body.name} is no longer awaited: its one-time token is invalid")
    else:
        say(
            f"{body.name} ({body.address}) is revoked;"
            f" {counted(body.taken_back, 'registration or grant', 'registrations and grants')} removed"
        )


def _days(valid: str) -> float:
    return bounded_span("--for", valid, "1s", "398d", "rosrv host") / _DAY


def _token_seconds(within: str | None, csr: Path | None, *, token: bool) -> float:
    if token and csr is not None:
        raise usage_error("--csr and --token exclude each other: with a token the host sends its own request")
    seconds = bounded_span("--within", within or "1h", "1m", "7d", "rosrv host")
    if within is not None and not token:
        raise usage_error("--within goes with --token: give both, or neither")
    return seconds


def _write_kit(
    running: Appliance, order: HostAdd | HostRenew, csr: Path | None, wishes: KitOptions, out: Path | None
) -> None:
    with new_output(out, f"rosrv-{order.name}.tar.gz", as_json=running.as_json) as output:
        key, request = key_and_request(csr)
        wishes, reason = placed(running, wishes)
        body = running.ask_or_exit(replace(order, request=request))
        write_kit(output, body, key, wishes, reason, as_json=running.as_json)


def _write_script(running: Appliance, order: HostToken, wishes: KitOptions, out: Path | None) -> None:
    services = [str(service) for service in parse_services(wishes.opened)]
    asked = replace(order, endpoint=wishes.endpoint or None, ports=wishes.ports, open=services)
    with new_output(out, f"rosrv-{order.name}-join.sh", as_json=running.as_json) as output:
        write_script(output, running.ask_or_exit(asked), as_json=running.as_json)


def _words(row: Host) -> list[str]:
    parts = [f"{row.name:<20} {row.address or '-':<16} {row.state:<13}"]
    if row.state == "up":
        parts.append(f"from {row.remote} for {row.seconds} s, {row.bytes_in} B in, {row.bytes_out} B out")
    if row.last_seen is not None:
        parts.append(f"last seen {moment(row.last_seen)}")
    if row.expires is not None and row.state != "revoked":
        parts.append(f"certificate until {moment(row.expires)}" + (" (soon!)" if row.expires_soon else ""))
    if row.token_expires is not None:
        by = f" by {row.token_by}" if row.token_by else ""
        parts.append(f"token{by} until {moment(row.token_expires)}")
    if row.state not in ("not enrolled", "revoked", "awaited"):
        parts.append(_ports_words(row.ports))
    if row.groups:
        parts.append(f"in {', '.join(row.groups)}")
    if row.divergence:
        parts.append(f"({row.divergence})")
    return parts


def _ports_words(ports: PortsSeen) -> str:
    if ports.checked is None:
        return "ports never checked"
    by = f" by {ports.who}" if ports.who else ""
    return f"ports {ports.state} ({moment(ports.checked)}{by})"
