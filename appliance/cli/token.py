"""`rosrv token add|list|revoke`: who may use REST, and as what."""

import datetime
from typing import Annotated

import typer

from appliance.channel.admin import TokenAdd, TokenList, TokenRevoke
from appliance.channel.answers.token_answers import TokenRole
from appliance.cli import completion
from appliance.cli.durations import span_given
from appliance.cli.output import moment, say_json
from appliance.cli.target import Appliance, speaks
from rosmop.tool.terminal import say


@speaks
def add(
    appliance: Appliance,
    name: Annotated[
        str, typer.Argument(help="Who will hold it: it stands in the audit log", show_default=False)
    ],
    role: Annotated[
        TokenRole,
        typer.Option(
            help="viewer: look; operator: also reload and roll back; admin: also load new policies; investigator: look,"
            " and fetch the messages of recordings"
        ),
    ] = "viewer",
    expires: Annotated[str, typer.Option(help="After this time it ends: 12h, 90d, 52w")] = "90d",
) -> None:
    """Make a token. Its text is printed once, here, and kept nowhere.

    Example: rosrv token add alice --role operator --expires 30d
    """
    seconds = span_given("--expires", expires, "30m, 12h, 90d or 52w")
    body = appliance.answer_or_exit(TokenAdd(name, role, seconds))
    say(body.token)
    typer.echo(
        f"rosrv: {body.role} {body.name}, until {moment(body.expires)}. This is the only time it is shown.",
        err=True,
    )


@speaks
def list_tokens(appliance: Appliance) -> None:
    """List all tokens that were made, without their secrets.

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
        say(f"{row.name:<24} {row.role:<12} {row.id}  made {moment(row.created)}  {end}")


@speaks
def revoke(
    appliance: Appliance,
    name: Annotated[
        str,
        typer.Argument(
            help="The name it was made with", show_default=False, autocompletion=completion.tokens
        ),
    ],
) -> None:
    """End a token now; exit status 1 when there is none of this name.

    Example: rosrv token revoke alice
    """
    body = appliance.answer_or_exit(TokenRevoke(name))
    say(f"token {body.name} ({body.role}) is revoked")
