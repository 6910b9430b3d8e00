"""`rosrv token add|list|revoke`: access tokens for REST and their roles."""

import datetime
from typing import Annotated

import typer

from appliance.channel.admin import TokenAdd, TokenList, TokenRevoke
from appliance.channel.answers.token_answers import TokenRole
from appliance.cli import completion
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import span_given
from appliance.cli.output import moment, say_json
from rosmop.tool.terminal import say


@speaks
def add(
    appliance: Appliance,
    name: Annotated[
        str, typer.Argument(help="Name of its holder, shown in the audit log", show_default=False)
    ],
    role: Annotated[
        TokenRole,
        typer.Option(
            help="viewer: read; operator: also reload and roll back; admin: also load new policies; investigator: read,"
            " and fetch the messages of recordings"
        ),
    ] = "viewer",
    expires: Annotated[str, typer.Option(help="Time until it expires: 12h, 90d, 52w")] = "90d",
) -> None:
    """Create a token. It is printed once and stored nowhere.

    Example: rosrv token add alice --role operator --expires 30d
    """
    seconds = span_given("--expires", expires, "30m, 12h, 90d or 52w")
    body = appliance.answer_or_exit(TokenAdd(name, role, seconds))
    say(body.token)
    typer.echo(
        f"rosrv: {body.role} {body.name}, until {moment(body.expires)}. It is not shown again.",
        err=True,
    )


@speaks
def list_tokens(appliance: Appliance) -> None:
    """List all tokens, without their secrets.

    Example: rosrv token list
    """
    now = datetime.datetime.now(datetime.UTC).timestamp()
    for row in appliance.ask_or_exit(TokenList()).tokens:
        if appliance.as_json:
            say_json(row)
            continue
        if row.revoked is not None:
            end = f"revoked {moment(row.revoked)}"
        else:
            end = f"{'expired' if row.expires <= now else 'until'} {moment(row.expires)}"
        say(f"{row.name:<24} {row.role:<12} {row.id}  created {moment(row.created)}  {end}")


@speaks
def revoke(
    appliance: Appliance,
    name: Annotated[
        str,
        typer.Argument(help="Name of the token", show_default=False, autocompletion=completion.tokens),
    ],
) -> None:
    """Revoke a token now. Exit status 1 if no token has this name.

    Example: rosrv token revoke alice
    """
    body = appliance.answer_or_exit(TokenRevoke(name))
    say(f"token {body.name} ({body.role}) is revoked")
