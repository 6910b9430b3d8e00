"""Choose the running appliance for a verb: over the socket in its state directory, or over REST.

A verb takes an `Appliance` as its first parameter; the decorator `speaks` adds the options `--state`, `--api`,
`--api-ca` and `--json`. The socket and REST give the same answers. The command line overrides the environment; within
the environment, REST overrides the socket.
"""

import functools
import inspect
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Concatenate, ParamSpec

import msgspec
import typer

from appliance.channel.admin import A, AdminAnswer, AdminRequest
from appliance.cli.connection.admin_client import AdminSocket, NotRunningError
from appliance.cli.output import Json, say_json, usage_error
from rosmop.tool.terminal import printable

if TYPE_CHECKING:
    from appliance.cli.connection.audit_file import FileLog
    from appliance.cli.connection.audit_over_rest import RestLog
    from appliance.cli.connection.rest_orders import RestWay
    from appliance.cli.connection.rest_session import RestClient
    from appliance.policy.host_names import HostInWords

DEFAULT_STATE = Path(
    "/var/lib/rosrv"
)  # repeats the default of appliance.configuration.settings, which is slow to import
TOKEN = "ROSRV_TOKEN"  # noqa: S105  the name of an environment variable
State = Annotated[
    Path,
    typer.Option(
        "--state",
        envvar="ROSRV_STATE",
        help="State directory of the running appliance",
        readable=False,  # the user needs only search permission
    ),
]
_P = ParamSpec("_P")


@dataclass(frozen=True)
class Appliance:
    """The appliance that a verb talks to.

    `said`: whether the command line or the environment names the appliance. `place`: the URL of REST; None over the
    socket. `as_json`: whether to print answers as JSON.
    """

    way: "AdminSocket | RestWay"
    said: bool = False
    place: str | None = None
    as_json: bool = False

    @property
    def rest(self) -> "RestClient":
        """Return the REST client of an appliance with a `place`."""
        assert not isinstance(self.way, AdminSocket)  # noqa: S101  it has no place
        return self.way.client

    def ask(self, request: AdminRequest[A]) -> AdminAnswer[A]:
        """Send one request to the running appliance. Raises `NotRunningError`."""
        return self.way.ask(request)

    def audit(self) -> "FileLog | RestLog":
        """Return the appliance's audit log; with a state directory, the appliance may be stopped."""
        return self.way.audit()

    @functools.cached_property
    def host_in_words(self) -> "HostInWords":
        """Return the function that names hosts by the policy in force; it returns addresses if no appliance answers."""
        from appliance.cli.connection.host_labels import named_by  # noqa: PLC0415  only for text with hosts

        return named_by(self.way)

    def ask_or_exit(self, request: AdminRequest[A]) -> A:
        """Return the answer's body. Exits with status 1 for a rejected request, and 2 if no appliance answers."""
        try:
            return self.body_or_exit(self.way.ask(request))
        except NotRunningError as error:
            raise usage_error(str(error)) from None

    def answer_or_exit(self, request: AdminRequest[A]) -> A:
        """Return the answer's body, as `ask_or_exit` does; with --json, print the body and exit instead."""
        body = self.ask_or_exit(request)
        if self.as_json:
            say_json(body)  # type: ignore[arg-type]  # each answer is a struct
            raise typer.Exit
        return body

    def body_or_exit(self, answer: AdminAnswer[A]) -> A:
        """Return the answer's body; print a rejection with its findings and exit with status 1."""
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
    """Replace a verb's first parameter, an `Appliance`, by --json and the options that choose an appliance."""
    return speaks_with(Json)(verb)


def speaks_here(verb: Callable[Concatenate[Appliance, _P], None]) -> Callable[_P, None]:
    """Like `speaks`, for a verb that REST does not offer: its help has no --api, whose use gets the reason."""
    return speaks_with(Json, over_rest=False)(verb)


def speaks_with(
    json: Any, *, over_rest: bool = True
) -> Callable[[Callable[Concatenate[Appliance, _P], None]], Callable[_P, None]]:
    """Like `speaks`, with this annotation of --json."""
    places = _places(hidden=not over_rest)

    def speaking(verb: Callable[Concatenate[Appliance, _P], None]) -> Callable[_P, None]:
        own = inspect.signature(verb, eval_str=True)

        @functools.wraps(verb)
        def asked(*args: _P.args, **kwargs: _P.kwargs) -> None:
            context, state, api, authority = (kwargs.pop(place.name) for place in places)
            as_json = kwargs.pop("as_json")
            appliance = _chosen(context, state, api, authority)  # type: ignore[arg-type]  # typer gives what they say
            verb(replace(appliance, as_json=as_json), *args, **kwargs)  # type: ignore[arg-type]  # as above

        # typer reads the options of a verb from its signature and annotations only.
        its_json = inspect.Parameter(
            "as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=json
        )
        parameters = [*list(own.parameters.values())[1:], its_json, *places]
        asked.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]  # what typer reads
        asked.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters} | {
            "return": None
        }
        return asked

    return speaking


def _places(*, hidden: bool) -> list[inspect.Parameter]:
    """Return the options that choose an appliance; `hidden`: the help leaves those for REST out."""
    api = typer.Option(
        "--api",
        metavar="URL",
        envvar="ROSRV_API_URL",
        help=f"Use REST instead; put the access token into {TOKEN}",
        hidden=hidden,
    )
    authority = typer.Option(
        "--api-ca",
        metavar="FILE",
        envvar="ROSRV_API_CA",
        help="Certificate to trust for REST (STATE/api/certificate.pem of the appliance)",
        hidden=hidden,
    )
    return [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        for name, default, annotation in (
            ("context", inspect.Parameter.empty, typer.Context),
            ("state", DEFAULT_STATE, State),
            ("api", None, Annotated[str | None, api]),
            ("api_ca", None, Annotated[Path | None, authority]),
        )
    ]


def _chosen(context: typer.Context, state: Path, api: str | None, authority: Path | None) -> Appliance:
    """Return the appliance that the options choose. Exits with status 2 for options that exclude each other."""
    sources = {name: context.get_parameter_source(name) for name in ("state", "api", "api_ca")}
    said = {name: "" if source is None else source.name for name, source in sources.items()}
    typed = {name for name, source in said.items() if source == "COMMANDLINE"}
    if {"state", "api"} <= typed:
        raise usage_error("--state and --api exclude each other: give one")
    if api is None or "state" in typed:
        if "api_ca" in typed:
            raise usage_error("--api-ca needs --api URL")
        return Appliance(AdminSocket(state), said=said["state"] in ("COMMANDLINE", "ENVIRONMENT"))
    from appliance.cli.connection.rest_orders import RestWay  # noqa: PLC0415  httpx is not imported for the socket

    try:
        way = RestWay(api, os.environ.get(TOKEN), authority)
    except ValueError as error:
        raise usage_error(str(error)) from None
    context.call_on_close(way.client.close)
    return Appliance(way, said=True, place=api)
