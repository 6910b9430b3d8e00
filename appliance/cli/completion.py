"""Complete names in the shell by querying the running appliance; without access, offer none and print no error."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import typer

from appliance.channel import admin
from appliance.channel.admin import A, AdminRequest
from appliance.cli.connection.admin_client import AdminSocket, NotRunningError

Complete = Callable[[typer.Context, str], list[str]]


def _names(request: AdminRequest[A], of: Callable[[A], Iterable[str]]) -> Complete:
    def complete(context: typer.Context, incomplete: str) -> list[str]:
        state = context.params.get("state") or "/var/lib/rosrv"
        try:
            answer = AdminSocket(Path(state)).ask(request)
        except (NotRunningError, OSError):
            return []
        said = context.params.get("names") or ()
        names = of(answer.unwrap()) if answer.ok else ()
        return sorted({name for name in names if name.startswith(incomplete) and name not in said})

    return complete


monitors = _names(admin.MonitorsWanted(), lambda body: [row.name for row in body.monitors])
tokens = _names(admin.TokenList(), lambda body: [row.name for row in body.tokens])
topics = _names(admin.GraphWanted(), lambda body: [row.name for row in body.topics])


def names_of_feature(verb: str, of: Callable[[Any], Iterable[str]]) -> Complete:
    def complete(context: typer.Context, incomplete: str) -> list[str]:
        from appliance.channel.operations import request_named  # noqa: PLC0415  only completion needs all features

        wanted: Any = request_named(verb)
        return [] if wanted is None else _names(wanted(), of)(context, incomplete)

    return complete


hosts = names_of_feature("host list", lambda body: [row.name for row in body.hosts])
