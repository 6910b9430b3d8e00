"""The commands `rosrv sso list|end`."""

from typing import Annotated

import typer

from appliance.base.counted import counted
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import moment, say_json, say_row
from appliance.features.sso.requests import SessionsEnd, SessionsWanted
from rosmop.tool.terminal import say


@speaks
def list_sessions(appliance: Appliance) -> None:
    """List the sessions of people who signed in at the single sign-on provider.

    Example: rosrv sso list
    """
    body = appliance.ask_or_exit(SessionsWanted())
    if appliance.as_json:
        say_json(body)
        return
    if not body.sessions:
        say("No person is signed in at the provider.")
    for session in body.sessions:
        groups = [f"doors {', '.join(session.groups)}"] if session.groups else []
        row = f"{session.name:<32} {session.role:<12} {session.id}"
        say_row([row, f"until {moment(session.expires)}", f"sub {session.subject}", *groups])


@speaks
def end(
    appliance: Appliance,
    name: Annotated[str, typer.Argument(help="Name of the person, as in the list", show_default=False)],
) -> None:
    """End all sessions of a person now. To keep them out, also remove their access at the single sign-on provider.

    Example: rosrv sso end sso:alice@example.org
    """
    body = appliance.ask_or_exit(SessionsEnd(name))
    if appliance.as_json:
        say_json(body)
        return
    say(f"{body.sessions[0].name}: {counted(len(body.sessions), 'session')} ended.")
