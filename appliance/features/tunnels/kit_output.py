"""Write a host's kit, or the script with which a host enrols itself."""

import contextlib
import functools
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import typer

from appliance.base.input_files import open_given
from appliance.cli import output
from appliance.cli.connection.target import Appliance
from appliance.cli.output import moment, say_json
from appliance.features.tunnels.enrolment_kit import archive
from appliance.features.tunnels.kits import KitOptions, kit_of
from appliance.features.tunnels.requests import HostEndpoint
from appliance.features.tunnels.tunnel_answers import EnrolmentToken, KitParts
from appliance.ipsec.requests import make_key, signing_request
from rosmop.tool.terminal import printable, refused, say

# Write a kit or a script to standard output, or to a new file that only its owner can read.
#
# Enrolment cannot be undone, and a token is shown only once. So the file is created, and disk space reserved,
# before the request is sent.

STANDARD_OUTPUT = Path("-")
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
            raise refused([f"rosrv: {self.path}: {error.strerror}; {lost}"]) from None
        self.written = True

    def say(self, line: str) -> None:
        if self.is_standard:
            typer.echo(printable(line), err=True)
        else:
            say(line)


@contextlib.contextmanager
def new_output(out: Path | None, default: str, *, as_json: bool) -> Iterator[Output]:
    """Existing files are never replaced, and a file that the block did not write is removed."""
    name = default.replace("/", "_")
    if out == STANDARD_OUTPUT:
        if as_json:
            raise usage_error("--output - and --json both use standard output: give one")
        if sys.stdout.isatty():
            raise usage_error("standard output is a terminal; redirect it: --output - > FILE")
        yield Output(out, name, sys.stdout.buffer)
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
