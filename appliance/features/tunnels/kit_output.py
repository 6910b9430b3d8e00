"""Write a host's kit, or the script with which a host enrols itself."""

import re
from dataclasses import replace
from pathlib import Path

import typer

from appliance.base.input_files import open_given
from appliance.cli.connection.target import Appliance
from appliance.cli.output import moment, say_json
from appliance.features.tunnels.enrolment_kit import archive
from appliance.features.tunnels.kits import KitOptions, kit_of
from appliance.features.tunnels.private_output import Output, usage_error
from appliance.features.tunnels.requests import HostEndpoint
from appliance.features.tunnels.tunnel_answers import EnrolmentToken, KitParts
from appliance.ipsec.requests import make_key, signing_request

_ENDPOINT = re.compile(r"[A-Za-z0-9][A-Za-z0-9.:-]{0,252}")
_LONGEST_REQUEST = 16 << 10


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


def placed(running: Appliance, wishes: KitOptions) -> tuple[KitOptions, str]:
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
    output.say(f"{body.name} is enrolled as {body.address}, until {moment(body.expires)}")
    kit = "standard output" if output.is_standard else str(output.path)
    output.say(f"its kit: {kit}" + ("" if key else " (without the private key, which the host has)"))
    if reason:
        output.say(_chosen(wishes.endpoint, reason))
    output.say("on the host: unpack it, then run sudo ./join.sh")


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
    output.say(made.token)
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
            return file.read(_LONGEST_REQUEST + 1).decode("ascii")
    except OSError as error:
        raise usage_error(f"--csr {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise usage_error(
            f"--csr {path}: not a signing request in PEM: make one with openssl req -new"
        ) from None
