"""The commands `rosrv host add|list|kit|reload|revoke`."""

import contextlib
import functools
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, BinaryIO

import typer
from msgspec import structs

from appliance.base.counted import counted
from appliance.base.input_files import open_given
from appliance.base.validation_messages import meant
from appliance.channel.answers.host_answers import Host, PortsSeen
from appliance.cli import completion, output
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import bounded_span
from appliance.cli.output import OR_STANDARD, STANDARD_OUTPUT, moment, new_file, say_json, say_row
from appliance.features.tunnels.enrolment_kit import archive
from appliance.features.tunnels.kits import KitOptions, kit_of
from appliance.features.tunnels.requests import (
    LONGEST_REQUEST,
    HostAdd,
    HostEndpoint,
    HostList,
    HostRenew,
    HostRevoke,
    HostsReload,
    HostToken,
)
from appliance.features.tunnels.tunnel_answers import EnrolmentToken, KitParts
from appliance.ipsec.requests import make_key, signing_request
from appliance.network.close_ports import parse_services
from rosmop.tool.terminal import printable, refusal, say

# Write a kit or a script to standard output, or to a new file that only its owner can read.
#
# Enrolment cannot be undone, and a token is shown only once. So the file is created, and disk space reserved,
# before the request is sent.

usage_error = functools.partial(output.usage_error, verb="rosrv host")
_RESERVED = 64 << 10  # bytes; a kit needs about ten thousand


class Output:
    """The output of a kit or script; `name` is the file's name on the host."""

    def __init__(self, path: Path, name: str, file: BinaryIO) -> None:
        self.path = path
        self.name = name
        self.written = False
        self._file = file

    @property
    def is_standard(self) -> bool:
        return self.path == STANDARD_OUTPUT

    def write(self, data: bytes, lost: str) -> None:
        """If the data cannot be written, print `lost`, which has the remedy."""
        try:
            self._file.write(data)
            if not self.is_standard:
                self._file.truncate()
            self._file.flush()
        except OSError as error:
            raise refusal([f"rosrv: {self.path}: {error.strerror}; {lost}"]) from None
        self.written = True


@contextlib.contextmanager
def new_output(out: Path | None, default: str) -> Iterator[Output]:
    """Existing files are never replaced, and a file that the block did not write is removed."""
    name = default.replace("/", "_")
    if out == STANDARD_OUTPUT:
        with new_file(out) as file:
            yield Output(out, name, file)
        return
    path = out or Path(name)
    with _open(path) as file:
        output = Output(path, path.name, file)
        try:
            yield output
        finally:
            if not output.written:
                path.unlink()


def _open(path: Path) -> BinaryIO:
    shown = printable(str(path))
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        raise usage_error(f"{shown} already exists: remove it, or name another file with --output") from None
    except OSError as error:
        raise usage_error(
            f"{shown}: {error.strerror}; name another: --output FILE, or --output - > FILE"
        ) from None
    try:
        os.posix_fallocate(descriptor, 0, _RESERVED)
    except OSError as error:
        os.close(descriptor)
        path.unlink()
        raise usage_error(
            f"{shown}: {error.strerror}; name another: --output FILE, or --output - > FILE"
        ) from None
    return os.fdopen(descriptor, "wb")


_ENDPOINT = re.compile(r"[A-Za-z0-9][A-Za-z0-9.:-]{0,252}")


def wishes_of(appliance: str | None, ports: str, opened: list[str] | None) -> KitOptions:
    """Return the options of a kit. The endpoint is empty if the appliance must choose it."""
    if appliance is not None and not _ENDPOINT.fullmatch(appliance):
        raise usage_error(
            f"--appliance {appliance!r} is neither an address nor a name: write 10.0.0.2 or robot.example.org"
        )
    try:
        return KitOptions(appliance or "", ports, tuple(opened or ()))
    except ValueError as error:
        raise usage_error(str(error)) from None


def with_endpoint(running: Appliance, wishes: KitOptions) -> tuple[KitOptions, str]:
    if wishes.endpoint:
        return wishes, ""
    found = running.ask_or_exit(HostEndpoint())
    return replace(wishes, endpoint=found.endpoint), found.reason


def key_and_request(csr: Path | None) -> tuple[str | None, str]:
    if csr is not None:
        return None, _read_request(csr)
    key = make_key()
    return key.decode(), signing_request(key, "host").decode()


def write_kit(
    output: Output, body: KitParts, key: str | None, wishes: KitOptions, reason: str, *, as_json: bool
) -> None:
    """`reason` explains an endpoint that the appliance chose."""
    again = (
        f"{body.name} is enrolled, but its kit was not written; run:"
        f" rosrv host kit {body.name} --appliance {wishes.endpoint} --output FILE"
    )
    output.write(archive(kit_of(body, wishes, key)), again)
    if body.warning:
        typer.echo(f"rosrv: {body.warning}", err=True)
    if not body.rest_url:
        typer.echo(
            f"rosrv: {body.name} cannot renew its certificate automatically: {body.rest_trouble}",
            err=True,
        )
    if as_json:
        shown = {
            "name": body.name,
            "address": body.address,
            "appliance": body.appliance,
            "master": body.master,
            "serial": body.serial,
            "expires": body.expires,
            "endpoint": wishes.endpoint,
            "endpoint_reason": reason,
            "kit": str(output.path),
        }
        say_json(shown)
        return
    say(f"{body.name} is enrolled as {body.address}, until {moment(body.expires)}")
    kit = "standard output" if output.is_standard else str(output.path)
    say(f"its kit: {kit}" + ("" if key else " (without the private key, which the host has)"))
    if reason:
        say(_chosen(wishes.endpoint, reason))
    say("on the host: unpack it, then run sudo ./join.sh")


def _chosen(endpoint: str, reason: str) -> str:
    return f"the appliance is at {endpoint} ({reason}); override it with --appliance"


def write_script(output: Output, made: EnrolmentToken, *, as_json: bool) -> None:
    output.write(made.script.encode(), "the token is lost: create another one")
    if as_json:
        shown = {
            "name": made.name,
            "address": made.address,
            "token": made.token,
            "endpoint": made.endpoint,
            "endpoint_reason": made.endpoint_reason,
            "token_expires": made.expires,
            "script": str(output.path),
        }
        say_json(shown)
        return
    say(made.token)
    if made.endpoint_reason:
        typer.echo(f"rosrv: {_chosen(made.endpoint, made.endpoint_reason)}", err=True)
    typer.echo(
        f"rosrv: {made.name} is awaited as {made.address} until {moment(made.expires)}; the token is"
        f" valid once and is not shown again.\nrosrv: on the host: sudo sh {output.name}   (it asks for the token)",
        err=True,
    )


def _read_request(path: Path) -> str:
    try:
        with open_given(path) as file:
            return file.read(LONGEST_REQUEST + 1).decode("ascii")
    except OSError as error:
        raise usage_error(f"--csr {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise usage_error(
            f"--csr {path}: not a signing request in PEM: make one with openssl req -new"
        ) from None


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
        help="File to write; must not exist (default: rosrv-NAME.tar.gz; with --token rosrv-NAME-join.sh);"
        f" {OR_STANDARD}",
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
    with new_output(out, f"rosrv-{order.name}.tar.gz") as output:
        key, request = key_and_request(csr)
        wishes, reason = with_endpoint(running, wishes)
        body = running.ask_or_exit(structs.replace(order, request=request))
        write_kit(output, body, key, wishes, reason, as_json=running.as_json)


def _write_script(running: Appliance, order: HostToken, wishes: KitOptions, out: Path | None) -> None:
    services = [str(service) for service in parse_services(wishes.opened)]
    asked = structs.replace(order, endpoint=wishes.endpoint or None, ports=wishes.ports, open=services)
    with new_output(out, f"rosrv-{order.name}-join.sh") as output:
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
