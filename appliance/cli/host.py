"""`rosrv host add|list|kit|revoke`: who may come through a tunnel."""

import datetime
import json
import os
import re
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from appliance.channel.admin import HostAdd, HostList, HostRenew, HostRevoke
from appliance.cli.policy_output import say
from appliance.cli.running import DEFAULT_STATE, State, ask_or_exit
from appliance.ipsec.kit import Kit, archive
from appliance.ipsec.requests import make_key, signing_request
from appliance.network.firewall.rules import PortRange
from appliance.network.protect import parse_services, protection

app = typer.Typer(help="Enrol, list and revoke hosts that come through IPsec tunnels.", no_args_is_help=True)

_Json = Annotated[bool, typer.Option("--json", help="Machine-readable output, one object per line")]
_Name = Annotated[str, typer.Argument(help="The host's name: `host:NAME` in the policy", show_default=False)]
_Appliance = Annotated[
    str,
    typer.Option(help="Address or name at which the host reaches the appliance (UDP 500 and 4500)"),
]
_Csr = Annotated[
    Path | None,
    typer.Option(help="Signing request (PEM) of a key that the host made: the kit has no private key then"),
]
_Days = Annotated[float, typer.Option(help="Days until the certificate ends")]
_Out = Annotated[Path | None, typer.Option(help="The kit [default: rosrv-NAME.tar.gz]")]
_Open = Annotated[
    list[str] | None, typer.Option("--open", help="Services of the host that stay open: tcp/22")
]
_Ports = Annotated[str, typer.Option(help="The host's local port range, where ROS nodes listen")]
_ENDPOINT = re.compile(r"[A-Za-z0-9][A-Za-z0-9.:-]{0,252}")
_LONGEST_REQUEST = 16 << 10


@app.command()
def add(  # noqa: PLR0917  typer gives every flag by its name
    name: _Name,
    appliance: _Appliance,
    address: Annotated[
        str | None, typer.Option(help="Its virtual address [default: the next free one]")
    ] = None,
    csr: _Csr = None,
    days: _Days = 90,
    out: _Out = None,
    opened: _Open = None,
    ports: _Ports = "32768-60999",
    state: State = DEFAULT_STATE,
    as_json: _Json = False,
) -> None:
    """Enrol a host and write its kit: one archive with all it needs to join.

    Example: rosrv host add ocu-1 --appliance 192.168.1.20
    """
    kit = _KitWriter(name, appliance, csr=csr, out=out, opened=opened, ports=ports)
    body = ask_or_exit(state, HostAdd(name, kit.request, days, address), as_json=as_json)
    kit.write(body, as_json=as_json)


@app.command()
def kit(  # noqa: PLR0917  as above
    name: _Name,
    appliance: _Appliance,
    csr: _Csr = None,
    days: _Days = 90,
    out: _Out = None,
    opened: _Open = None,
    ports: _Ports = "32768-60999",
    state: State = DEFAULT_STATE,
    as_json: _Json = False,
) -> None:
    """Write a new kit for an enrolled host: a new certificate; the one before is revoked and its tunnel closed.

    Example: rosrv host kit ocu-1 --appliance 192.168.1.20
    """
    writer = _KitWriter(name, appliance, csr=csr, out=out, opened=opened, ports=ports)
    body = ask_or_exit(state, HostRenew(name, writer.request, days), as_json=as_json)
    writer.write(body, as_json=as_json)


@app.command("list")
def list_hosts(state: State = DEFAULT_STATE, as_json: _Json = False) -> None:
    """List the hosts that are enrolled or declared, with their tunnels.

    Example: rosrv host list
    """
    for row in ask_or_exit(state, HostList(), as_json=as_json)["hosts"]:
        if as_json:
            _print(json.dumps(row))
            continue
        parts = [f"{row['name']:<20} {row['address'] or '-':<16} {row['state']:<13}"]
        if row["state"] == "up":
            parts.append(
                f"from {row['remote']} for {row['seconds']} s, {row['bytes_in']} B in, {row['bytes_out']} B out"
            )
        elif row["last_seen"] is not None:
            parts.append(f"last seen {_moment(row['last_seen'])}")
        if row["expires"] is not None and row["state"] != "revoked":
            parts.append(f"certificate until {_moment(row['expires'])}")
        if row["state"] not in ("not enrolled", "revoked") and not row["declared"]:
            parts.append("(not declared)")
        say("  ".join(parts))


@app.command()
def revoke(name: _Name, state: State = DEFAULT_STATE, as_json: _Json = False) -> None:
    """Let a host in no more, close its tunnel and take back what it has, now.

    Example: rosrv host revoke ocu-1
    """
    body = ask_or_exit(state, HostRevoke(name), as_json=as_json)
    if as_json:
        _print(json.dumps(body))
    else:
        say(
            f"{body['name']} ({body['address']}) is revoked; {body['taken_back']} registrations and grants taken back"
        )


class _KitWriter:
    """Checks everything that can be wrong before the appliance is asked, makes the key, writes the archive."""

    def __init__(
        self,
        name: str,
        appliance: str,
        *,
        csr: Path | None,
        out: Path | None,
        opened: list[str] | None,
        ports: str,
    ) -> None:
        if not _ENDPOINT.fullmatch(appliance):
            raise _usage_error(f"--appliance {appliance!r} is neither an address nor a name")
        self._endpoint = appliance
        self._path = out or Path(f"rosrv-{name.replace('/', '_')}.tar.gz")
        if self._path.exists():
            raise _usage_error(f"{self._path} is there already: remove it, or name another with --out")
        first, _, last = ports.partition("-")
        try:
            self._ports = PortRange(int(first), int(last or first))
            self._open = parse_services(opened or [])
        except ValueError as error:
            raise _usage_error(str(error)) from None
        self._key: str | None = None
        if csr is None:
            key = make_key()
            self._key = key.decode()
            self.request = signing_request(key, "host").decode()
        else:
            self.request = _read_request(csr)

    def write(self, body: dict[str, Any], *, as_json: bool) -> None:
        """Write the archive, for its owner only."""
        data = archive(
            Kit(
                name=body["name"],
                address=body["address"],
                appliance=body["appliance"],
                endpoint=self._endpoint,
                master=body["master"],
                certificate=body["certificate"],
                authority=body["authority"],
                key=self._key,
                protect=protection([body["appliance"]], self._ports, self._open),
            )
        )
        try:
            descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
        except OSError as error:
            typer.echo(
                f"rosrv: {self._path}: {error.strerror}; {body['name']} is enrolled, its kit is not written:"
                f" rosrv host kit {body['name']} --appliance {self._endpoint} --out FILE",
                err=True,
            )
            raise typer.Exit(1) from None
        if body["warning"]:
            typer.echo(f"rosrv: {body['warning']}", err=True)
        if as_json:
            _print(json.dumps({key: body[key] for key in _SHOWN} | {"kit": str(self._path)}))
            return
        say(f"{body['name']} is enrolled as {body['address']}, until {_moment(body['expires'])}")
        say(
            f"its kit: {self._path}" + ("" if self._key else " (without the private key, which the host has)")
        )
        say("on the host: unpack it, then sudo ./join.sh")


_SHOWN = ("name", "address", "appliance", "master", "serial", "expires")


def _usage_error(text: str) -> typer.Exit:
    """Write what was wrong with the command line; raise the result (exit status 2)."""
    typer.echo(f"rosrv host: {text}", err=True)
    return typer.Exit(2)


def _read_request(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(_LONGEST_REQUEST + 1).decode("ascii")
    except OSError as error:
        raise _usage_error(f"--csr {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise _usage_error(f"--csr {path}: not a signing request in PEM") from None


def _moment(seconds: float) -> str:
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).strftime("%Y-%m-%d %H:%MZ")


def _print(line: str) -> None:
    sys.stdout.write(line + "\n")
