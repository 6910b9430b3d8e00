"""The argument of the verbs that take one record of the audit log."""

from typing import Annotated

import typer


def _without_sign(record: str) -> str:
    return record.removeprefix("#")


RecordArgument = Annotated[
    str,
    typer.Argument(
        metavar="RECORD", help="Id of the record, or its number, also as '#12'", callback=_without_sign
    ),
]
