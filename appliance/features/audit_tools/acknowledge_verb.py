"""`rosrv audit acknowledge`: set aside a log that the signer signed, and that is no longer the present one."""

import json
from typing import Annotated

import typer

from appliance.cli.audit.audit_errors import CANNOT_READ, Errors, fail
from appliance.cli.audit.verification_text import signed_log_text, write
from appliance.cli.connection.audit_file import FileLog
from appliance.cli.connection.audit_source import audit_of
from appliance.cli.connection.target import Appliance, speaks_with


@speaks_with("One JSON object for each log that the signer signed")
def acknowledge_log(
    appliance: Appliance,
    log: Annotated[
        str | None, typer.Argument(help="Id of the log, or its beginning; default: list all logs")
    ] = None,
) -> None:
    """Acknowledge that a log is no longer the present one, for example because you moved a damaged log away.

    The signer remembers every log that it signed. If one of them is missing, `rosrv audit verify` fails until you
    acknowledge it here, as root on the machine: not over REST, because a process that can replace the log must not
    hide that. A log whose beginning the signer no longer remembers is acknowledged in the same way.

    Exit status without LOG: 1 if a log needs an acknowledgement.

    Example: rosrv audit acknowledge 3f2a
    """
    with Errors():
        source = audit_of(appliance.way)
        if not isinstance(source, FileLog):
            fail("only root on the machine can do this: run it there with --state", CANNOT_READ)
        present, logs = source.present(), source.signed_logs()
        if log is not None:
            chosen = [one for one in logs if one.log.startswith(log)]
            if len(chosen) != 1:
                known = ", ".join(one.log for one in logs) or "none"
                fail(f"{log!a} is not the beginning of one log's id; the signer signed: {known}", 1)
            if not chosen[0].needs_acknowledgement(present):
                what = "is the present log" if chosen[0].log == present else "was set aside before"
                fail(f"log {chosen[0].log} {what}: there is nothing to acknowledge", 1)
            source.acknowledge(chosen[0])
            logs = source.signed_logs()
        for one in logs:
            write(json.dumps(one.as_object(present)) if appliance.as_json else signed_log_text(one, present))
    if log is None and any(one.needs_acknowledgement(present) for one in logs):
        raise typer.Exit(1)
