"""Send an operator's request to a running collector."""

import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import httpx
import typer

from appliance.audit.log.record_format import printable
from appliance.base.input_files import read_given
from appliance.base.system_errors import without_number

NO_TOKEN = Path("token")
_NOT_FOUND = 404
Url = Annotated[
    str, typer.Option("--collector", envvar="ROSRV_FLEET_COLLECTOR", metavar="URL", help="https://HOST:PORT")
]
Authority = Annotated[
    Path | None,
    typer.Option("--ca", envvar="ROSRV_FLEET_CA", metavar="FILE", help="Authority of its certificate"),
]
Token = Annotated[
    Path,
    typer.Option("--token-file", envvar="ROSRV_FLEET_TOKEN_FILE", metavar="FILE", help="Your access token"),
]


@contextmanager
def answer_to(
    method: str,
    path: str,
    url: str,
    ca: Path | None,
    token_file: Path,
    *,
    not_found: str = "",
    seconds: float = 60.0,
    **given: Any,
) -> Iterator[httpx.Response]:
    """Yield the collector's answer before its body is read.

    `not_found` is added to the error for the status 404. An error, including one of the block, is printed, and the
    command exits with status 1.
    """
    try:
        token = read_given(token_file, 4096).decode().strip()
        with httpx.stream(
            method,
            f"{url.rstrip('/')}/v1/{path}",
            headers={"Authorization": f"Bearer {token}"},
            verify=ssl.create_default_context(cafile=ca),
            timeout=seconds,
            trust_env=False,
            **given,
        ) as answer:
            if answer.is_error:
                answer.read()
            answer.raise_for_status()
            yield answer
            return
    except httpx.HTTPStatusError as error:
        status = error.response.status_code
        reason = f"{status}: {_detail(error.response)}{not_found if status == _NOT_FOUND else ''}"
    except (httpx.HTTPError, OSError, ValueError) as error:
        reason = without_number(error)
    typer.echo(f"rosrv-fleet: {printable(reason)}", err=True)
    raise typer.Exit(1)


def _detail(answer: httpx.Response) -> str:
    try:
        detail = answer.json()["detail"]
    except (ValueError, TypeError, KeyError):
        detail = None
    return detail if isinstance(detail, str) else answer.text[:1000]
