"""Which running appliance a verb is for, and how it is asked: over the socket in its state directory, or over REST.

A verb that speaks to an appliance takes an `Appliance` first and is decorated with `speaks`, which gives it the
options `--state`, `--api` and `--api-ca`. Whatever way is taken, the same question has the same answer. What is said
on the command line goes before the environment, and of the environment REST before the socket.
"""

import functools
import inspect
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Concatenate, ParamSpec

import msgspec
import typer

from appliance.channel.admin import A, AdminAnswer, AdminRequest
from appliance.cli.admin_client import AdminSocket, NotRunningError
from appliance.cli.output import Json, say_json, usage_error
from rosmop.tool.terminal import printable

if TYPE_CHECKING:
    from appliance.cli.audit.log_over_rest import RestLog
    from appliance.cli.audit.source import FileLog
    from appliance.cli.rest.orders import RestWay
    from appliance.cli.rest.session import RestClient

DEFAULT_STATE = Path(
    "/var/lib/rosrv"
)  # as appliance.configuration.settings has it, which is not imported for every verb
TOKEN = "ROSRV_TOKEN"  # noqa: S105  the name of the variable that has it
State = Annotated[
    Path,
    typer.Option(
        "--state",
        envvar="ROSRV_STATE",
        help="State directory of the running appliance",
        readable=False,  # it may be passed through, not looked into; who may not connect is told so
    ),
]
Api = Annotated[
    str | None,
    typer.Option(
        "--api",
        metavar="URL",
        envvar="ROSRV_API_URL",
        help=f"Ask over REST instead; the access token is in {TOKEN}",
    ),
]
ApiCa = Annotated[
    Path | None,
    typer.Option(
        "--api-ca",
        metavar="FILE",
        envvar="ROSRV_API_CA",
        help="Certificate that REST is trusted by (STATE/api/certificate.pem of the appliance)",
    ),
]
_P = ParamSpec("_P")


@dataclass(frozen=True)
class Appliance:
    """The appliance that a verb is for.

    `said`: it was named, on the command line or in the environment. `place` is the URL of REST; None over the socket.
    `as_json`: what is shown of its answers is for programs.
    """

    way: "AdminSocket | RestWay"
    said: bool = False
    place: str | None = None
    as_json: bool = False

    @property
    def rest(self) -> "RestClient":
        """What calls REST, of an appliance that has a `place`."""
        assert not isinstance(self.way, AdminSocket)  # noqa: S101  it has none
        return self.way.client

    def ask(self, request: AdminRequest[A]) -> AdminAnswer[A]:
        """Ask the running appliance one thing. Raises `NotRunningError`."""
        return self.way.ask(request)

    def audit(self) -> "FileLog | RestLog":
        """Its audit log; over the state directory it need not run."""
        return self.way.audit()

    def ask_or_exit(self, request: AdminRequest[A]) -> A:
        """The answer's body. Ends the program with 1 when it refuses, 2 when none can be asked."""
        try:
            return self.body_or_exit(self.way.ask(request))
        except NotRunningError as error:
            raise usage_error(str(error)) from None

    def answer_or_exit(self, request: AdminRequest[A]) -> A:
        """The same for a person to read: with --json the answer is written here as it is, and the verb ends."""
        body = self.ask_or_exit(request)
        if self.as_json:
            say_json(body)  # type: ignore[arg-type]  # each answer is a struct
            raise typer.Exit
        return body

    def body_or_exit(self, answer: AdminAnswer[A]) -> A:
        """The answer's body; a refusal is shown whole and ends the program with status 1."""
        if answer.ok:
            return answer.given()
        if self.as_json:
            typer.echo(msgspec.json.encode({"error": answer.error, "findings": answer.findings}).decode())
        else:
            for finding in answer.findings:
                typer.echo(printable(finding), err=True)
            typer.echo(f"rosrv: {printable(answer.error)}", err=True)
        raise typer.Exit(1)


def speaks(verb: Callable[Concatenate[Appliance, _P], None]) -> Callable[_P, None]:
    """Give a verb whose first parameter is an `Appliance` the options that say which, and --json if it has none."""
    own = inspect.signature(verb, eval_str=True)
    its_json = next(filter(lambda name: name.startswith("as_json"), own.parameters), None)

    @functools.wraps(verb)
    def asked(*args: _P.args, **kwargs: _P.kwargs) -> None:
        context, state, api, authority = (kwargs.pop(place.name) for place in _PLACES)
        as_json = kwargs[its_json] if its_json else kwargs.pop(_JSON.name)
        appliance = _chosen(context, state, api, authority)  # type: ignore[arg-type]  # typer gives what they say
        verb(replace(appliance, as_json=as_json), *args, **kwargs)  # type: ignore[arg-type]  # as above

    parameters = [*list(own.parameters.values())[1:], *([] if its_json else [_JSON]), *_PLACES]
    asked.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]  # what typer reads
    asked.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters} | {
        "return": None
    }
    return asked


_JSON = inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Json)
_PLACES = [
    inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
    for name, default, annotation in (
        ("context", inspect.Parameter.empty, typer.Context),
        ("state", DEFAULT_STATE, State),
        ("api", None, Api),
        ("api_ca", None, ApiCa),
    )
]


def _chosen(context: typer.Context, state: Path, api: str | None, authority: Path | None) -> Appliance:
    """The appliance at one of both places. Ends the program with 2 when that makes no sense."""
    sources = {name: context.get_parameter_source(name) for name in ("state", "api", "api_ca")}
    said = {name: getattr(source, "name", "") for name, source in sources.items()}
    typed = {name for name, source in said.items() if source == "COMMANDLINE"}
    if {"state", "api"} <= typed:
        raise usage_error("--state and --api are two ways to the appliance: give one")
    if api is None or "state" in typed:
        if "api_ca" in typed:
            raise usage_error("--api-ca is for --api URL, which is not given")
        return Appliance(AdminSocket(state), said=said["state"] in ("COMMANDLINE", "ENVIRONMENT"))
    from appliance.cli.rest.orders import RestWay  # noqa: PLC0415  httpx is not imported for the socket

    try:
        way = RestWay(api, os.environ.get(TOKEN), authority)
    except ValueError as error:
        raise usage_error(str(error)) from None
    context.call_on_close(way.client.close)
    return Appliance(way, said=True, place=api)
