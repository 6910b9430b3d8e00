"""What `rosrv host` writes for a host: its kit, or the script by which it enrols itself."""

import re
from dataclasses import replace
from pathlib import Path

import typer

from appliance.api.kits import Wishes, kit_of
from appliance.base.input_files import open_given
from appliance.channel.admin import HostEndpoint
from appliance.channel.answers.host_answers import EnrolmentToken, KitParts
from appliance.cli.host.private_output import Output, usage_error
from appliance.cli.output import moment, say_json
from appliance.cli.target import Appliance
from appliance.ipsec.enrolment_kit import archive
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


def placed(running: Appliance, wishes: Wishes) -> tuple[Wishes, str]:
    """The wishes with the address of the appliance, and why it is that where nobody said it.

    Ends the program with 1 when it cannot be told.
    """
    if wishes.endpoint:
        return wishes, ""
    found = running.ask_or_exit(HostEndpoint())
    return replace(wishes, endpoint=found.endpoint), found.reason


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

    def write(self, body: KitParts, wishes: Wishes, reason: str, *, as_json: bool) -> None:
        """Write the archive; `reason`: why the appliance's address is that, empty where it was said."""
        output = self._output
        again = (
            f"{body.name} is enrolled, its kit is not written:"
            f" rosrv host kit {body.name} --appliance {wishes.endpoint} --out FILE"
        )
        output.write(archive(kit_of(body, wishes, self._key)), again)
        if body.warning:
            typer.echo(f"rosrv: {body.warning}", err=True)
        if not body.rest_url:
            typer.echo(
                f"rosrv: {body.name} cannot renew its certificate by itself: {body.rest_trouble}", err=True
            )
        if as_json:
            where = {"endpoint": wishes.endpoint, "endpoint_reason": reason}
            say_json({key: getattr(body, key) for key in _SHOWN} | where | {"kit": str(output.path)})
            return
        output.say(f"{body.name} is enrolled as {body.address}, until {moment(body.expires)}")
        kit = "standard output" if output.is_standard else str(output.path)
        output.say(
            f"its kit: {kit}" + ("" if self._key else " (without the private key, which the host has)")
        )
        if reason:
            output.say(_taken(wishes.endpoint, reason))
        output.say("on the host: unpack it, then sudo ./join.sh")


def _taken(endpoint: str, reason: str) -> str:
    return f"the appliance is at {endpoint} ({reason}); another: --appliance"


def write_script(output: Output, made: EnrolmentToken, *, as_json: bool) -> None:
    """Write the script of a host that was given a one-time token, and print the token."""
    output.write(made.script.encode(), "the token is lost: ask for another one")
    if as_json:
        shown = {
            key: getattr(made, key) for key in ("name", "address", "token", "endpoint", "endpoint_reason")
        }
        say_json(shown | {"token_expires": made.expires, "script": str(output.path)})
        return
    output.say(made.token)
    if made.endpoint_reason:
        typer.echo(f"rosrv: {_taken(made.endpoint, made.endpoint_reason)}", err=True)
    typer.echo(
        f"rosrv: {made.name} is awaited as {made.address} until {moment(made.expires)}; the token is"
        f" good once and shown only here.\nrosrv: on the host: sudo sh {output.name}   (it asks for the token)",
        err=True,
    )


def _read_request(path: Path) -> str:
    try:
        with open_given(path) as file:
            return file.read(_LONGEST_REQUEST + 1).decode("ascii")
    except OSError as error:
        raise usage_error(f"--csr {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise usage_error(f"--csr {path}: not a signing request in PEM") from None
