"""Choose the running appliance for a verb: over the socket in its state directory, or over REST.

A verb takes an `Appliance` as its first parameter, and the decorator `speaks` adds the options. The command line
overrides the environment; within the environment, REST overrides the socket.
"""

import ipaddress
import os
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Concatenate, ParamSpec

import msgspec
import typer

from appliance.api.routes.named_hosts import HostLabels, host_in_words
from appliance.base.option_group import GroupedCommand, GroupedVerb, OptionGroup
from appliance.channel.admin import A, AdminAnswer, AdminRequest, PolicyWanted
from appliance.cli.connection.admin_client import (
    QUICK_SECONDS,
    AdminSocket,
    NotRunningError,
    RestProblemError,
)
from appliance.cli.output import Json, say_json, usage_error
from appliance.policy.host_names import HostInWords, in_words
from rosmop.tool.terminal import printable

if TYPE_CHECKING:
    from typer._click import Context

    from appliance.cli.connection.rest_orders import RestWay
    from appliance.cli.connection.rest_session import RestClient
    from appliance.policy.host_names import HostInWords


def named_by(way: "AdminSocket | RestWay") -> HostInWords:
    if isinstance(way, AdminSocket):
        return _named_by_socket(way.state)
    return _named_by_rest(way)


def _named_by_socket(state: Path) -> HostInWords:
    try:
        answer = AdminSocket(state, QUICK_SECONDS, 0.1).ask(PolicyWanted())
    except NotRunningError:
        return str
    return host_in_words(answer.unwrap() if answer.ok else None)


def _named_by_rest(way: "RestWay") -> HostInWords:
    try:
        found = msgspec.convert(way.client.call("GET", "/v1/policy/hosts"), HostLabels)
    except (NotRunningError, RestProblemError, msgspec.ValidationError):  # an earlier version has no names
        return str
    labels = [(ipaddress.ip_network(row.network), row.name) for row in found.labels]
    return partial(in_words, labels=labels)


DEFAULT_STATE = Path(
    "/var/lib/rosrv"
)  # repeats the default of appliance.configuration.settings, which is slow to import
TOKEN = "ROSRV_TOKEN"  # noqa: S105  the name of an environment variable
State = Annotated[
    Path,
    typer.Option(
        "--state",
        envvar="ROSRV_STATE",
        help="State directory of the appliance",
        readable=False,  # the user needs only search permission
    ),
]
_P = ParamSpec("_P")


@dataclass(frozen=True)
class _Target:
    way: "AdminSocket | RestWay"
    said: bool
    place: str | None = None


class Appliance(typer.Context):
    """A call of a verb, with the appliance that its options choose.

    `said`: whether the command line or the environment names the appliance.
    """

    @cached_property
    def target(self) -> _Target:
        return _CHOICE.value(self.params)

    @property
    def way(self) -> "AdminSocket | RestWay":
        return self.target.way

    def state_here(self, verb: str) -> Path:
        """Return the state directory of this machine's appliance; exit with status 2 for one that REST reaches."""
        if isinstance(self.way, AdminSocket):
            return self.way.state
        raise usage_error("this works on the appliance's machine only: give --state instead of --api", verb)

    @property
    def said(self) -> bool:
        return self.target.said

    @property
    def place(self) -> str | None:
        return self.target.place

    @property
    def as_json(self) -> bool:
        return bool(self.params["as_json"])

    @property
    def rest(self) -> "RestClient":
        assert not isinstance(self.way, AdminSocket)  # noqa: S101  it has no place
        return self.way.client

    def ask(self, request: AdminRequest[A]) -> AdminAnswer[A]:
        return self.way.ask(request)

    @cached_property
    def host_in_words(self) -> "HostInWords":
        return named_by(self.way)

    def ask_or_exit(self, request: AdminRequest[A]) -> A:
        """Return the answer; exit with status 1 for a rejected request, and 2 if no appliance answers."""
        try:
            return self.body_or_exit(self.way.ask(request))
        except NotRunningError as error:
            raise usage_error(str(error)) from None

    def answer_or_exit(self, request: AdminRequest[A]) -> A:
        body = self.ask_or_exit(request)
        if self.as_json:
            say_json(body)  # type: ignore[arg-type]  # each answer is a struct
            raise typer.Exit
        return body

    def body_or_exit(self, answer: AdminAnswer[A]) -> A:
        if answer.ok:
            return answer.unwrap()
        if self.as_json:
            typer.echo(msgspec.json.encode({"error": answer.error, "findings": answer.findings}).decode())
        else:
            for finding in answer.findings:
                typer.echo(printable(finding), err=True)
            typer.echo(f"rosrv: {printable(answer.error)}", err=True)
        raise typer.Exit(1)

    def body_now(self, answer: AdminAnswer[A]) -> A:
        """Return the body, for a verb that asks again. Raises `NotRunningError` for every rejection."""
        if not answer.ok:
            raise NotRunningError(answer.error)
        return answer.unwrap()


class _ApplianceCommand(GroupedCommand):
    context_class = Appliance

    def __init__(
        self,
        name: str | None = None,
        *,
        json_help: str | None = None,
        over_rest: bool = True,
        **settings: Any,
    ) -> None:
        after = tuple(map(copy, _CHOICE.options))
        for option in after:
            if option.name == "as_json":
                option.help = json_help or option.help
            elif option.name != "state":
                option.hidden = not over_rest
        super().__init__(name, after=after, **settings)

    def invoke(self, ctx: "Context") -> object:
        assert isinstance(ctx, Appliance) and ctx.way  # noqa: S101  options that exclude each other end the call before the verb acts
        return super().invoke(ctx)


def speaks(verb: Callable[Concatenate[Appliance, _P], None]) -> GroupedVerb:
    return GroupedVerb(verb, _ApplianceCommand)


def speaks_here(verb: Callable[Concatenate[Appliance, _P], None]) -> GroupedVerb:
    """Decorate a verb that REST does not offer: its help lacks --api, whose use is answered with the reason."""
    return GroupedVerb(verb, partial(_ApplianceCommand, over_rest=False))


def speaks_with(
    json_help: str, group: OptionGroup[Any] | None = None
) -> Callable[[Callable[Concatenate[Appliance, _P], None]], GroupedVerb]:
    def command(name: str | None = None, **settings: Any) -> GroupedCommand:
        before = () if group is None else group.options
        return _ApplianceCommand(name, before=before, json_help=json_help, **settings)

    return lambda verb: GroupedVerb(verb, command)


def _choose(
    *,
    as_json: Json = False,  # noqa: ARG001  `Appliance.as_json` reads it
    context: typer.Context,
    state: State = DEFAULT_STATE,
    api: Annotated[
        str | None,
        typer.Option(
            "--api",
            metavar="URL",
            envvar="ROSRV_API_URL",
            help=f"Use REST at this URL instead of --state; put the access token into {TOKEN}",
        ),
    ] = None,
    api_ca: Annotated[
        Path | None,
        typer.Option(
            "--api-ca",
            metavar="FILE",
            envvar="ROSRV_API_CA",
            help="Certificate to trust for REST, as `rosrv certificate` prints it on the appliance",
        ),
    ] = None,
) -> _Target:
    """Return the chosen appliance; exit with status 2 for options that exclude each other."""
    sources = {name: context.get_parameter_source(name) for name in ("state", "api", "api_ca")}
    said = {name: "" if source is None else source.name for name, source in sources.items()}
    typed = {name for name, source in said.items() if source == "COMMANDLINE"}
    if {"state", "api"} <= typed:
        raise usage_error("--state and --api exclude each other: give one")
    if api is None or "state" in typed:
        if "api_ca" in typed:
            raise usage_error("--api-ca needs --api URL")
        return _Target(AdminSocket(state, tells=True), said=said["state"] in ("COMMANDLINE", "ENVIRONMENT"))
    from appliance.cli.connection.rest_orders import RestWay  # noqa: PLC0415  httpx is not imported for the socket

    try:
        way = RestWay(api, os.environ.get(TOKEN), api_ca)
    except ValueError as error:
        raise usage_error(str(error)) from None
    context.call_on_close(way.client.close)
    return _Target(way, said=True, place=api)


_CHOICE = OptionGroup(_choose)
