"""`rosrv evidence export|verify|verifier`: what happened in one file that proves itself elsewhere."""

import errno
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

import typer

from appliance.audit.record_format import rfc3339
from appliance.audit.timestamps import parse_moment
from appliance.base.atomic_files import name_to_make
from appliance.cli import completion
from appliance.cli.admin_client import AdminSocket
from appliance.cli.audit.audit_errors import Errors, fail
from appliance.cli.durations import Since, Until
from appliance.cli.output import Json, say_json, usage_error
from appliance.cli.rest.orders import RestWay
from appliance.cli.rest.session import ProblemError
from appliance.cli.target import Appliance, speaks
from appliance.evidence import bundle_verifier as verifier_module
from appliance.evidence.bundle import VERIFIER, BundleError, Kept, Span, export
from appliance.signing.fingerprints import fingerprint
from rosmop.tool.terminal import say

_SILENCE_SECONDS = 3600.0  # it is made twice before the first byte comes


@speaks
def export_evidence(
    appliance: Appliance,
    recording: Annotated[
        str | None,
        typer.Argument(
            metavar="[RECORDING]",
            help="The messages of this recording, and its time",
            autocompletion=completion.recordings,
        ),
    ] = None,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="File (ZIP), must not exist")],
    since: Since = None,
    until: Until = None,
) -> None:
    """Write what the log has of a time, and what was in force, as a bundle that proves itself anywhere.

    It is on record who did. In the bundle are the recording, if it is of one, the audit records, the policies and
    specifications in force, signed checkpoints, a page for people and the verifier.

    Example: rosrv evidence export --since 2026-03-01T10:00Z --until 2026-03-01T11:00Z -o incident.zip
    """
    with Errors():
        if (recording is None) is (since is None) or (recording is not None and until is not None):
            raise usage_error("give a recording, or --since (and --until)")
        now = time.time_ns()
        span = Span(parse_moment(since or "0s", now), parse_moment(until or "0s", now))
        size, part = 0, name_to_make(output)
        if os.path.lexists(output):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(output))
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            with os.fdopen(descriptor, "wb") as file:
                for piece in _bundle(appliance, recording or span):
                    size += file.write(piece)
            part.rename(output)
        except BaseException as error:
            part.unlink()
            if isinstance(error, BundleError | ProblemError):
                fail(str(error), 1)
            raise
    if appliance.as_json:
        say_json({"file": str(output), "bytes": size})
    else:
        say(f"{output}: {size} bytes; prove it: python3 verify.py {output.name} --key audit.pub")


def _bundle(appliance: Appliance, wanted: str | Span) -> Iterator[bytes]:
    match appliance.way:
        case AdminSocket(state=state):
            asked = Kept(wanted, state / "recordings") if isinstance(wanted, str) else wanted
            yield from export(state / "control" / "audit.db", asked, appliance.ask)
        case RestWay(client=client):
            path, params = "/v1/evidence", {}
            if isinstance(wanted, str):
                path = f"/v1/recordings/{quote(wanted, safe='')}/evidence"
            else:
                params = {"since": rfc3339(wanted.since), "until": rfc3339(wanted.until)}
            with client.streamed("GET", path, params=params, seconds=_SILENCE_SECONDS) as answer:
                yield from answer.iter_bytes()


def verify(
    bundle: Annotated[Path, typer.Argument(help="What `rosrv evidence export` wrote, or the folder of it")],
    key: Annotated[
        Path | None, typer.Option("--key", help="Public key (PEM) of the appliance, kept elsewhere")
    ] = None,
    checkpoints: Annotated[
        Path | None, typer.Option("--checkpoints", help="What `rosrv audit checkpoints` gave, kept elsewhere")
    ] = None,
    as_json: Json = False,
) -> None:
    """Hold a bundle against what the appliance signed: exit status 0 right, 1 not, 2 when it is no bundle.

    The same as `python3 verify.py`, which is in each bundle and needs no appliance.

    Example: rosrv evidence verify incident.zip --key /media/safe/audit.pub
    """
    options = {"--key": key, "--checkpoints": checkpoints}
    given = [word for name, file in options.items() if file is not None for word in (name, str(file))]
    raise typer.Exit(verifier_module.main([str(bundle), *given, *(["--json"] if as_json else [])]))


def verifier(as_json: Json = False) -> None:
    """Write the verifier that comes with this version, for who does not trust the one in a bundle.

    Example: rosrv evidence verifier > verify.py
    """
    text = VERIFIER.read_text(encoding="utf-8")
    if as_json:
        say_json({"sha256": fingerprint(text), "text": text})
    else:
        sys.stdout.write(text)
