"""What `rosrv host` writes for a host: its kit, or the script by which it enrols itself."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import typer

from appliance.api.kits import Wishes, enrolment_of, kit_of
from appliance.channel.admin import HostEndpoint
from appliance.cli.host.output import Output, usage_error
from appliance.cli.output import moment, say_json
from appliance.cli.running import Appliance
from appliance.ipsec.kit import archive
from appliance.ipsec.requests import make_key, signing_request

_ENDPOINT = re.compile(r"[A-Za-z0-9][A-Za-z0-9.:-]{0,252}")
_LONGEST_REQUEST = 16 << 10
_SHOWN = ("name", "address", "appliance", "master", "serial", "expires")


def wishes_of(appliance: str | None, ports: str, opened: list[str] | None) -> Wishes:
    """What the flags ask for; the endpoint is empty where they leave it to the appliance.

    Ends the program with 2 when that makes no sense.
    """
    if appliance is not None and not _ENDPOINT.fullmatch(appliance):
        raise usage_error(f"--appliance {appliance!r} is neither an address nor a name")
    try:
        return Wishes(appliance or "", ports, tuple(opened or ()))
    except ValueError as error:
        raise usage_error(str(error)) from None


@dataclass(frozen=True)
class Placed:
    """What a host is given; `reason`: why the appliance took its own address for that, empty where it was said."""

    wishes: Wishes
    reason: str = ""


def place(running: Appliance, wishes: Wishes, *, as_json: bool) -> Placed:
    """The wishes with the address of the appliance, which it finds where nobody said it.

    Over REST it is found when the order is carried out, and the answer has it. Ends the program with 1 when it
    cannot be told.
    """
    if wishes.endpoint or running.remote:
        return Placed(wishes)
    body = running.ask_or_exit(HostEndpoint(), as_json=as_json)
    return Placed(replace(wishes, endpoint=body["endpoint"]), body["reason"])


class KitWriter:
    """Checks everything that can be wrong before the appliance is asked, makes the key, writes the archive."""

    def __init__(self, output: Output, *, csr: Path | None) -> None:
        self._output = output
        self._key: str | None = None
        if csr is None:
            key = make_key()
            self._key = key.decode()
            self.request = signing_request(key, "host").decode()
        else:
            self.request = _read_request(csr)

    def write(self, body: dict[str, Any], placed: Placed, *, as_json: bool) -> None:
        """Write the archive."""
        wishes, output = placed.wishes, self._output
        again = (
            f"{body['name']} is enrolled, its kit is not written:"
            f" rosrv host kit {body['name']} --appliance {wishes.endpoint} --out FILE"
        )
        output.write(archive(kit_of(body, wishes, self._key)), again)
        if body["warning"]:
            typer.echo(f"rosrv: {body['warning']}", err=True)
        if not body["rest_url"]:
            typer.echo(
                f"rosrv: {body['name']} cannot renew its certificate by itself: {body['rest_trouble']}",
                err=True,
            )
        if as_json:
            where = {"endpoint": wishes.endpoint, "endpoint_reason": placed.reason}
            say_json({key: body[key] for key in _SHOWN} | where | {"kit": str(output.path)})
            return
        output.say(f"{body['name']} is enrolled as {body['address']}, until {moment(body['expires'])}")
        kit = "standard output" if output.is_standard else str(output.path)
        output.say(
            f"its kit: {kit}" + ("" if self._key else " (without the private key, which the host has)")
        )
        if placed.reason:
            output.say(_taken(wishes.endpoint, placed.reason))
        output.say("on the host: unpack it, then sudo ./join.sh")


def _taken(endpoint: str, reason: str) -> str:
    return f"the appliance is at {endpoint} ({reason}); another: --appliance"


def write_script(output: Output, body: dict[str, Any], placed: Placed, *, as_json: bool) -> None:
    """Write the script of a host that was given a one-time token, and print the token."""
    try:
        script = body.get("script") or enrolment_of(body, placed.wishes).script()
    except ValueError as error:
        typer.echo(f"rosrv: {error}", err=True)
        raise typer.Exit(1) from None
    endpoint = body.get("endpoint", placed.wishes.endpoint)
    reason = body.get("endpoint_reason", placed.reason)
    output.write(script.encode(), "the token is lost: ask for another one")
    if as_json:
        shown = {key: body[key] for key in ("name", "address", "token", "token_expires")}
        where = {"endpoint": endpoint, "endpoint_reason": reason}
        say_json(shown | where | {"script": str(output.path)})
        return
    output.say(body["token"])
    if reason:
        typer.echo(f"rosrv: {_taken(endpoint, reason)}", err=True)
    typer.echo(
        f"rosrv: {body['name']} is awaited as {body['address']} until {moment(body['token_expires'])}; the token is"
        f" good once and shown only here.\nrosrv: on the host: sudo sh {output.name}   (it asks for the token)",
        err=True,
    )


def _read_request(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(_LONGEST_REQUEST + 1).decode("ascii")
    except OSError as error:
        raise usage_error(f"--csr {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise usage_error(f"--csr {path}: not a signing request in PEM") from None
