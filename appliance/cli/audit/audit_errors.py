"""What goes wrong when the audit log is read, in words and with an exit status."""

import os
import sys
from typing import NoReturn

import typer

from appliance.audit.copies import CopiesUnreadableError
from appliance.audit.export_proof import ExportUnreadableError
from appliance.audit.log_database import LogUnreadableError
from appliance.audit.query import FilterError
from appliance.audit.record_format import printable
from appliance.audit.signatures import KeyUnreadableError
from appliance.audit.timestamps import MomentError
from appliance.cli.admin_client import NotRunningError

CANNOT_READ = 2


class Errors:
    """Says in words what went wrong, and ends with the exit status for it."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        match error:
            case LogUnreadableError() | KeyUnreadableError() | CopiesUnreadableError() | NotRunningError():
                fail(str(error), CANNOT_READ)
            case FilterError() | MomentError() | ExportUnreadableError():
                fail(str(error), CANNOT_READ)
            case BrokenPipeError():
                # The reader (head, less) has enough: what is still buffered has nowhere to go.
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                raise typer.Exit(0)
            case KeyboardInterrupt():
                raise typer.Exit(0)
            case PermissionError():
                fail(f"{error.filename}: {error.strerror}; run this as root", CANNOT_READ)
            case OSError():
                fail(f"{error.filename or 'output'}: {error.strerror}", CANNOT_READ)


def tell(text: str) -> None:
    """A line beside the output."""
    sys.stderr.write(f"rosrv: {text}\n")


def fail(text: str, status: int) -> NoReturn:
    """Say what is wrong and end."""
    tell(printable(text))
    raise typer.Exit(status)
