"""Print the errors of the audit verbs, and exit with their statuses."""

import os
import sys
from contextlib import ContextDecorator
from typing import NoReturn

import typer

from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.record_format import printable
from appliance.audit.log.signatures import KeyUnreadableError
from appliance.audit.proof.copies import CopiesUnreadableError
from appliance.audit.search.query import FilterError
from appliance.base.timestamps import TimestampError
from appliance.base.user_errors import with_remedy
from appliance.cli.connection.admin_client import NotRunningError

CANNOT_READ = 2


class Errors(ContextDecorator):
    """Prints an error of the audit log and exits with its status; `unread` is the status if the reader ends."""

    def __init__(self, unread: int = 0) -> None:
        self._unread = unread

    def __enter__(self) -> None:
        pass

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        match error:
            case LogUnreadableError() | KeyUnreadableError() | CopiesUnreadableError() | NotRunningError():
                fail(str(error), CANNOT_READ)
            case FilterError() | TimestampError():
                fail(str(error), CANNOT_READ)
            case BrokenPipeError():
                # The reader (head, less) has ended: discard the buffered output.
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                raise typer.Exit(self._unread)
            case KeyboardInterrupt():
                raise typer.Exit(0)
            case OSError():
                fail(with_remedy(error, error.filename or "output"), CANNOT_READ)


def note(text: str) -> None:
    sys.stderr.write(f"rosrv: {text}\n")


def fail(text: str, status: int) -> NoReturn:
    note(printable(text))
    raise typer.Exit(status)
