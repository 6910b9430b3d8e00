"""Show the state of two appliances on a terminal: for `rosrv standby status`, and `rosrv status` on a standby."""

from dataclasses import dataclass

from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from appliance.api.front.moments import in_full
from appliance.cli.output import moment
from appliance.cli.status_watch import StatusView
from appliance.features.standby.answers import StandbyState
from appliance.features.standby.status_line import answer_in_words, connection, lag_in_words
from appliance.features.standby.summary import follower_troubles

_RED = "bold red"


def standby_view(state: StandbyState) -> StatusView:
    return StatusView(
        1 if state.troubles or state.witness.follower_trouble else 0, StandbyScreen(state), in_full(state)
    )


@dataclass(frozen=True, slots=True)
class StandbyScreen:
    """The state as text, problems first."""

    state: StandbyState

    def __rich_console__(self, _console: Console, _options: ConsoleOptions) -> RenderResult:
        state = self.state
        for trouble in [*state.troubles, *(trouble.text for trouble in follower_troubles(state))]:
            yield Text(f"! {trouble}", style=_RED)
        other, witness = state.other, state.witness
        grid = Table.grid(padding=(0, 2))
        role = f"{state.role} since {moment(state.since)}, epoch {state.epoch}"
        grid.add_row("this appliance", f"{state.name} ({state.address}): {role}")
        seen = lag_in_words(other) if state.role == "active" else connection(other)
        holder = f", {witness.holder or 'no appliance'} holds the lease" if not witness.refusal else ""
        grid.add_row("other appliance", f"{other.name} ({other.address}): {seen}")
        grid.add_row("witness", f"{witness.address}: {answer_in_words(witness)}{holder}")
        grid.add_row("robot's address", f"{state.fixed}, for the active appliance")
        if state.role == "active":
            grid.add_row("answers", _answers(state))
        yield grid


def _answers(state: StandbyState) -> str:
    if state.answers_alone:
        return "do not wait for the standby, because it is not in sync"
    return "wait until the standby has stored each change"
