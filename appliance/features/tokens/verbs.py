"""`rosrv token add|rotate|list|revoke`: access tokens for REST and their roles."""

from typing import Annotated

import typer

from appliance.channel.admin import TokenAdd, TokenList, TokenRevoke, TokenRotate
from appliance.channel.answers.token_answers import NewToken, Token, TokenRole
from appliance.cli import completion
from appliance.cli.connection.admin_client import AdminSocket
from appliance.cli.connection.target import Appliance, speaks, speaks_here
from appliance.cli.durations import bounded_span
from appliance.cli.output import moment, say_json, say_row
from rosmop.tool.terminal import say

_Name = Annotated[
    str, typer.Argument(help="Name of the token", show_default=False, autocompletion=completion.tokens)
]


@speaks_here
def add(
    appliance: Appliance,
    name: Annotated[
        str, typer.Argument(help="Name of its holder, shown in the audit log", show_default=False)
    ],
    role: Annotated[
        TokenRole,
        typer.Option(
            metavar="ROLE",
            help="viewer: read; investigator: also fetch the messages of recordings, which no other role may;"
            " operator: read, reload, roll back, approve, block hosts, make tickets; admin: also load policies and"
            " specifications, enrol hosts, end tokens",
        ),
    ] = "viewer",
    *,
    lifetime: Annotated[str, typer.Option("--for", help="Time until it expires: 12h, 90d, 52w")] = "90d",
) -> None:
    """Create a token. It is printed once and stored nowhere.

    Example: rosrv token add alice --role operator --for 30d
    """
    seconds = bounded_span("--for", lifetime, "1s", "3650d", "rosrv token")
    _say_new(appliance.answer_or_exit(TokenAdd(name, role, seconds)))


@speaks_here
def rotate(
    appliance: Appliance,
    name: _Name,
    *,
    lifetime: Annotated[
        str | None,
        typer.Option(
            "--for",
            help="Time until the new token expires: 12h, 90d, 52w (default: as for the earlier token)",
        ),
    ] = None,
    grace: Annotated[
        str | None,
        typer.Option(
            help="Keep the earlier token valid for this time, such as 10m (default: it ends now)",
        ),
    ] = None,
) -> None:
    """Replace a token with a new one with the same name and role. It is printed once and stored nowhere.

    With --grace, the earlier token stays valid for that time, so that its holder can change to the new one.

    Example: rosrv token rotate dashboard --grace 10m
    """
    order = TokenRotate(
        name,
        None if lifetime is None else bounded_span("--for", lifetime, "1s", "3650d", "rosrv token"),
        0.0 if grace is None else bounded_span("--grace", grace, "1s", "3650d", "rosrv token"),
    )
    body = appliance.ask_or_exit(order)
    for row in body.earlier:
        if row.revoked is not None:
            _forget_first(appliance, row)
    if appliance.as_json:
        say_json(body)
        return
    _say_new(body)
    for row in body.earlier:
        end = "has ended" if row.revoked is not None else f"is valid until {moment(row.expires)}"
        typer.echo(f"rosrv: the earlier token {row.id} {end}.", err=True)


def _say_new(body: NewToken) -> None:
    say(body.token)
    typer.echo(
        f"rosrv: {body.role} {body.name}, until {moment(body.expires)}. It is not shown again.",
        err=True,
    )


def _forget_first(appliance: Appliance, ended: Token) -> None:
    if not isinstance(appliance.way, AdminSocket):
        return
    file = appliance.way.state / "first-token"
    try:
        if f"_{ended.id}_" not in file.read_text(encoding="ascii"):
            return
        file.unlink()
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        typer.echo(f"rosrv: {file} may have the text of a token that has ended: {error}", err=True)
        return
    typer.echo(f"rosrv: {file} is removed: its token has ended.", err=True)


@speaks
def list_tokens(appliance: Appliance) -> None:
    """List all tokens, without their secrets, with the time of their last use (to within a minute).

    Example: rosrv token list
    """
    body = appliance.ask_or_exit(TokenList())
    for row in body.tokens:
        if appliance.as_json:
            say_json(row)
            continue
        if row.revoked is not None:
            end = f"revoked {moment(row.revoked)}"
        else:
            end = f"{'until' if row.valid else 'expired'} {moment(row.expires)}"
        used = _use(row, body.uses_since)
        say_row([f"{row.name:<24} {row.role:<12} {row.id}", f"created {moment(row.created)}", end, used])


def _use(row: Token, since: float) -> str:
    if row.last_used is not None:
        return f"last used {moment(row.last_used)}"
    return "never used" if row.created >= since else f"not used since {moment(since)}"


@speaks
def revoke(
    appliance: Appliance,
    name: _Name,
) -> None:
    """Revoke a token now. Exit status 1 if no token has this name.

    Example: rosrv token revoke alice
    """
    body = appliance.ask_or_exit(TokenRevoke(name))
    _forget_first(appliance, body)
    if appliance.as_json:
        say_json(body)
        return
    say(f"token {body.name} ({body.role}) is revoked")
