"""The commands `rosrv evidence export|verify|verifier`."""

import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

import typer

from appliance.audit.log.record_format import rfc3339
from appliance.audit.search.filter_options import Since, Until
from appliance.cli import completion
from appliance.cli.audit.audit_errors import Errors, fail
from appliance.cli.connection.admin_client import AdminSocket, RestProblemError
from appliance.cli.connection.rest_orders import RestWay
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import time_given
from appliance.cli.output import OR_STANDARD, Json, new_file, say_json, usage_error
from appliance.features.evidence.bundle import (
    BundleError,
    RecordingSelection,
    TimeSpan,
    export,
    verifier_program,
)
from appliance.features.evidence.page import Names
from appliance.formats import bundle_verifier as verifier_module
from appliance.signing.fingerprints import fingerprint
from rosmop.tool.terminal import say

_SILENCE_SECONDS = 3600.0  # the appliance builds a bundle twice before it sends the first byte


@speaks
def export_evidence(
    appliance: Appliance,
    recording: Annotated[
        str | None,
        typer.Argument(
            metavar="RECORDING",
            help="Export the messages and the time of this recording",
            autocompletion=completion.names_of_feature(
                "recordings", lambda body: [row.id for row in body.recordings]
            ),
        ),
    ] = None,
    *,
    output: Annotated[
        Path, typer.Option("--output", "-o", help=f"File (ZIP), must not exist; {OR_STANDARD}")
    ],
    since: Since = None,
    until: Until = None,
) -> None:
    """Export the audit log of a period as a bundle that can be verified anywhere.

    Give a recording, or --since with or without --until. The bundle holds the recording (if one is given), the audit
    records, the policies and specifications in force, signed checkpoints, a readable page and the verifier. The audit
    log records the export.

    Example: rosrv evidence export --since 10:00 --until 11:00 -o incident.zip
    """
    with Errors():
        if (recording is None) is (since is None) or (recording is not None and until is not None):
            raise usage_error("give a recording, or --since (and --until)")
        span = TimeSpan(time_given("--since", since or "0s"), time_given("--until", until or "0s"))
        size = 0
        try:
            with new_file(output) as file:
                for piece in _bundle(appliance, recording or span):
                    size += file.write(piece)
                    file.flush()
        except (BundleError, RestProblemError) as error:
            fail(str(error), 1)
    if appliance.as_json:
        say_json({"file": str(output), "bytes": size})
    else:
        say(
            f"{output}: {size} bytes; verify it: python3 verify.py {shlex.quote(output.name)} --key audit.pub"
        )


def _bundle(appliance: Appliance, wanted: str | TimeSpan) -> Iterator[bytes]:
    match appliance.way:
        case AdminSocket(state=state) as socket:
            asked = RecordingSelection(wanted, state / "recordings") if isinstance(wanted, str) else wanted
            names = Names(socket.robot_name(), appliance.host_in_words)
            yield from export(state / "control" / "audit.db", asked, appliance.ask, names)
        case RestWay(client=client):
            path, params = "/v1/evidence", {}
            if isinstance(wanted, str):
                path = f"/v1/recordings/{quote(wanted, safe='')}/evidence"
            else:
                params = {"since": rfc3339(wanted.since), "until": rfc3339(wanted.until)}
            with client.stream("GET", path, params=params, seconds=_SILENCE_SECONDS) as answer:
                yield from answer.iter_bytes()


def verify(
    bundle: Annotated[
        Path, typer.Argument(help="Bundle written by `rosrv evidence export`, or its unpacked folder")
    ],
    key: Annotated[
        Path | None, typer.Option("--key", help="Public key (PEM) of the appliance, kept on another machine")
    ] = None,
    checkpoints: Annotated[
        Path | None,
        typer.Option("--checkpoints", help="Output of `rosrv audit checkpoints`, kept on another machine"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Verify a bundle. Exit status: 0 valid, 1 invalid, 2 not a bundle.

    It does the same as `python3 verify.py`, which is in each bundle and does not need an appliance.

    Example: rosrv evidence verify incident.zip --key /media/safe/audit.pub
    """
    options = {"--key": key, "--checkpoints": checkpoints}
    given = [word for name, file in options.items() if file is not None for word in (name, str(file))]
    raise typer.Exit(verifier_module.main([str(bundle), *given, *(["--json"] if as_json else [])]))


def verifier(as_json: Json = False) -> None:
    """Print the verifier of this version, so that you need not trust the copy in a bundle.

    Example: rosrv evidence verifier > verify.py
    """
    text = verifier_program()
    if as_json:
        say_json({"sha256": fingerprint(text), "text": text})
    else:
        sys.stdout.write(text)
