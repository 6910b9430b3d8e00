"""The commands `rosrv standby status|switch`, for a running appliance."""

import threading
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import typer
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from appliance.api.front.moments import in_full
from appliance.base import clock
from appliance.cli.connection.admin_client import AccessDeniedError, NotRunningError
from appliance.cli.connection.target import Appliance, speaks, speaks_with
from appliance.cli.output import moment, say_json, usage_error
from appliance.cli.standing import WITHIN, WhenStanding, Within, stand_or_exit
from appliance.cli.status_watch import StatusView, Watch, seconds_between, watch_status
from appliance.features.standby.answers import StandbyState
from appliance.features.standby.requests import StandbyPromote, StandbyWanted
from appliance.features.standby.summary import CHECKING, present_troubles
from appliance.features.standby.view import answer_in_words, connection, lag_in_words
from rosmop.tool.terminal import printable, say

# Show the state of two appliances on a terminal: for `rosrv standby status`, and `rosrv status` on a standby.

_RED = "bold red"


def standby_view(state: StandbyState) -> StatusView:
    troubled = state.troubles or any(present_troubles(state))
    return StatusView(1 if troubled else 0, StandbyScreen(state), in_full(state))


@dataclass(frozen=True, slots=True)
class StandbyScreen:
    """The state as text, problems first."""

    state: StandbyState

    def __rich_console__(self, _console: Console, _options: ConsoleOptions) -> RenderResult:
        state = self.state
        for trouble in [*state.troubles, *(trouble.text for trouble in present_troubles(state))]:
            yield Text(f"! {trouble}", style=_RED)
        other, witness = state.other, state.witness
        grid = Table.grid(padding=(0, 2))
        role = f"{state.role} since {moment(state.since)}, epoch {state.epoch}"
        grid.add_row("this appliance", f"{state.name} ({state.address}): {role}")
        seen = lag_in_words(other) if state.role == "active" else connection(other)
        holder = f", {witness.holder or 'no appliance'} holds the lease" if not witness.refusal else ""
        grid.add_row("other appliance", f"{other.name} ({other.address}): {seen}")
        if state.obstacle == CHECKING:
            grid.add_row("standby", CHECKING)
        grid.add_row("witness", f"{witness.address}: {answer_in_words(witness)}{holder}")
        grid.add_row("robot's address", f"{state.fixed}, for the active appliance")
        if state.role == "active":
            grid.add_row("answers", _answers(state))
        yield grid


def _answers(state: StandbyState) -> str:
    if state.answers_alone:
        return "do not wait for the standby, because it is not in sync"
    return "wait until the standby has stored each change"


_VERB = "rosrv standby"
_SWITCH_SECONDS = 20.0
_AGAIN_SECONDS = 0.2
_SHOW_SECONDS = 2.0


@speaks_with("One JSON object; with --watch, one on each line")
def status(
    appliance: Appliance,
    *,
    watch: Watch = False,
    every: Annotated[
        str | None,
        typer.Option(
            help="With --watch: the time between two states, 1s to 1h (default: 2s)", show_default=False
        ),
    ] = None,
) -> None:
    """Show both appliances and the witness: which one is active, and how far behind the standby is.

    Exit status, on both appliances: 0 if the standby could take over now; 1 if not, or if the active appliance does not
    serve or a follower reports trouble, with the reason; 2 if no appliance runs.

    Example: rosrv standby status --watch
    """
    each = seconds_between(every, _VERB, watch=watch)
    if watch:
        try:
            raise typer.Exit(watch_status(partial(_look, appliance), each, as_json=appliance.as_json))
        except NotRunningError as error:
            raise usage_error(str(error)) from None
    view = standby_view(appliance.ask_or_exit(StandbyWanted()))
    if appliance.as_json:
        say_json(view.fields)
    else:
        Console(highlight=False).print(view.screen)
    raise typer.Exit(view.exit_status)


@speaks
def switch(appliance: Appliance, *, when_standing: WhenStanding = False, within: Within = WITHIN) -> None:
    """Make the standby the active appliance, for example before an update: a planned switchover.

    Give the order on the active appliance, or on the standby's own machine; with --when-standing, on the active one.
    It waits until the standby is active, at most 20 s. Exit status: 0 switched over, 1 not, with the reason, 2 no
    appliance runs.

    Example: rosrv standby switch
    """
    before = appliance.ask_or_exit(StandbyWanted())
    name = before.other.name if before.role == "active" else before.name
    if when_standing:
        stand_or_exit(appliance, within, _VERB)
    typer.echo(f"{_VERB}: {printable(name)} is to take over from {_holder(before)}", err=True)
    lost = ""
    try:
        appliance.body_or_exit(appliance.ask(StandbyPromote()))
    except AccessDeniedError as error:
        raise usage_error(str(error)) from None
    except NotRunningError as error:
        lost = f" ({printable(str(error))})"  # a switchover ends the process that answers
    after = _held_by(name, appliance)
    if after is None:
        text = f"{printable(name)} is not active after {_SWITCH_SECONDS:g} s{lost}; see: rosrv standby status"
        typer.echo(f"{_VERB}: {text}", err=True)
        raise typer.Exit(1)
    if appliance.as_json:
        say_json(after)
    else:
        say(f"{printable(name)} is active, epoch {after.epoch}")


def _look(appliance: Appliance) -> StatusView:
    answer = appliance.ask(StandbyWanted())
    read = appliance.body_or_exit if answer.trouble == "unknown" else appliance.body_now
    return standby_view(read(answer))


def _holder(state: StandbyState) -> str:
    return printable(state.witness.holder) or "no appliance"


def _held_by(name: str, appliance: Appliance) -> StandbyState | None:
    pause, began = threading.Event(), clock.now()
    shown, until = began, began + _SWITCH_SECONDS
    while (now := clock.now()) < until:
        if now - shown >= _SHOW_SECONDS:
            shown = now
            typer.echo(f"{_VERB}: waiting for {printable(name)}, {now - began:.0f} s", err=True)
        try:
            answer = appliance.ask(StandbyWanted())
        except NotRunningError:
            answer = None  # the process that answers is being started again
        if answer is not None and answer.ok:
            state = answer.unwrap()
            if state.witness.holder == name:
                return state
        pause.wait(_AGAIN_SECONDS)
    return None
