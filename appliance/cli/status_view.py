"""How `rosrv status` lays out what takes the most room: the processes, side by side where the window is wide enough."""

import datetime
import time
from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from appliance.channel.answers.status import ClockState, ProcessInfo
from appliance.channel.status_summary import process_names
from rosmop.tool.tables import table_of

_YELLOW = "yellow"
_COLUMN = 38  # columns that one process takes


def processes_table(rows: Sequence[ProcessInfo], width: int, now: float | None = None) -> Table:
    """The processes in as many columns as fit, read downwards; processes of one role are numbered from 0."""
    across = max(1, min(3, width // _COLUMN))
    high = -(-len(rows) // across)
    table = table_of(*["process", "pid", "for", "restarts"] * across)
    shown = [_cells(row, name, now) for row, name in zip(rows, process_names(rows), strict=True)]
    for line in range(high):
        cells: list[Text] = []
        for place in range(line, len(shown), high):
            cells += shown[place]
        table.add_row(*cells)
    return table


def _cells(row: ProcessInfo, name: str, now: float | None) -> list[Text]:
    since = datetime.datetime.fromisoformat(row.since).timestamp()
    restarts = Text(str(row.restarts), style=_YELLOW if row.restarts else "")
    return [Text(name), Text(str(row.pid)), Text(age(since, now)), restarts]


def lacking_walls(rows: Sequence[ProcessInfo]) -> str | None:
    """What this kernel lacks of the walls around the processes, as far as a line holds it; None: they all stand."""
    lacking = [f"{row.role}: {what}" for row in rows for what in row.lacks]
    if not lacking:
        return None
    return lacking[0] + (f" and {len(lacking) - 1} more (rosrv status --json)" if len(lacking) > 1 else "")


def doubted_clock(clock: ClockState) -> str | None:
    """Why the times of records cannot be believed; None: they can."""
    if clock.before_program_seconds:
        days = clock.before_program_seconds / 86_400
        return f"wrong: it stands {days:.0f} days before this program was made; set it before hosts get certificates"
    if clock.behind_seconds:
        return f"set back: it stands {clock.behind_seconds:.0f} s before the last record"
    if clock.synchronised is None:
        return "unknown whether it is synchronised: the kernel does not tell"
    return None if clock.synchronised else "not synchronised: run chrony or systemd-timesyncd"


def age(since: float, now: float | None = None) -> str:
    """How long ago a moment (seconds since the epoch) was, in at most two units."""
    seconds = max(0, int((time.time() if now is None else now) - since))
    days, rest = divmod(seconds, 86_400)
    hours, rest = divmod(rest, 3_600)
    minutes, left = divmod(rest, 60)
    if days:
        return f"{days} d {hours} h"
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {left} s" if minutes else f"{left} s"


def shortened(lines: Sequence[str], most: int) -> list[str]:
    """The first lines; that there are more is said in the last."""
    if len(lines) <= most:
        return list(lines)
    return [*lines[: most - 1], f"and {len(lines) - most + 1} more: rosrv status --json"]
