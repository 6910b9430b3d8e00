"""Show the state of two appliances on a terminal: for `rosrv standby status`, and `rosrv status` on a standby."""

from dataclasses import dataclass

from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from appliance.api.front.moments import in_full
from appliance.channel.answers.standby_answers import OtherAppliance, StandbyState, WitnessSeen
from appliance.cli.output import moment
from appliance.cli.status_watch import StatusView
from appliance.features.standby.standby_summary import is_silent, lag_of, lasting, standby_troubles

_RED, _YELLOW = "bold red", "yellow"


def standby_view(state: StandbyState) -> StatusView:
    """Return the state as a terminal shows it; its exit status is 1 if something is wrong."""
    troubles = [trouble.text for trouble in standby_troubles(state)]
    fields = {**in_full(state), "troubles": troubles}
    return StatusView(1 if troubles else 0, StandbyScreen(state, troubles), fields)


@dataclass(frozen=True, slots=True)
class StandbyScreen:
    """The state as text, problems first."""

    state: StandbyState
    troubles: list[str]

    def __rich_console__(self, _console: Console, _options: ConsoleOptions) -> RenderResult:
        """Yield its parts."""
        for trouble in self.troubles:
            yield Text(f"! {trouble}", style=_RED)
        state = self.state
        other, witness = state.other, state.witness
        grid = Table.grid(padding=(0, 2))
        role = f"{state.role} since {moment(state.since)}, epoch {state.epoch}"
        grid.add_row("this appliance", f"{state.name} ({state.address}): {role}")
        seen = lag_in_words(other) if state.role == "active" else _connection(other)
        holder = f"{witness.holder} holds" if witness.holder else "no appliance holds"
        grid.add_row("other appliance", f"{other.name} ({other.address}): {seen}")
        grid.add_row("witness", f"{witness.address}: {answer_in_words(witness)}, {holder} the lease")
        grid.add_row("robot's address", f"{state.fixed}, for the active appliance")
        if state.role == "active":
            grid.add_row("answers", _answers(state))
        yield grid


def standby_line(state: StandbyState) -> Text:
    """Return the state in a line of `rosrv status`."""
    other, witness = lag_in_words(state.other), answer_in_words(state.witness)
    line = f"{state.name} is {state.role}; {state.other.name}: {other}; witness: {witness}"
    return Text(line, style=_YELLOW if any(standby_troubles(state)) else "")


def lag_in_words(other: OtherAppliance) -> str:
    """Return how well the standby follows this active appliance."""
    if other.connected:
        return "in sync" if other.in_sync else lag_of(other)
    return _connection(other)


def answer_in_words(witness: WitnessSeen) -> str:
    seconds = witness.answered_seconds
    if seconds is None:
        return "has never answered"
    return f"silent for {lasting(seconds)}" if is_silent(witness) else "answers"


def _connection(other: OtherAppliance) -> str:
    if other.connected:
        return "connected"
    away = "" if other.trouble_seconds is None else f" for {lasting(other.trouble_seconds)}"
    return f"away{away}" + (f": {other.reason}" if other.reason else "")


def _answers(state: StandbyState) -> str:
    if state.wait == "none":
        return "do not wait for the standby (availability.wait: none)"
    if state.answers_alone:
        return "do not wait for the standby, because it is not in sync"
    return "wait until the standby has stored each change"
