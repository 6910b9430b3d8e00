"""The command `rosrv limits`."""

from appliance.channel.answers.limit_answers import LimitUse
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import say_json, say_row
from appliance.features.limits.requests import LimitsWanted
from appliance.policy.host_names import HostInWords

_NEARLY = 0.8  # of a limit: the row is marked
_UNITS = (("GB", 1e9), ("MB", 1e6), ("kB", 1e3))


@speaks
def limits(appliance: Appliance) -> None:
    """Show the use and the limit of the resources that hosts use up first, and the hosts that are nearest to a limit.

    A row with `!` has at least 80 percent in use.

    Example: rosrv limits
    """
    rows = appliance.ask_or_exit(LimitsWanted()).limits
    width = max(len(row.resource) for row in rows)
    for row in rows:
        if appliance.as_json:
            say_json(row)
            continue
        near = _is_near(row)
        say_row(
            [f"{'!' if near else ' '} {row.resource:<{width}}", *_cells(row, appliance.host_in_words)],
            "yellow" if near else "",
        )


def _is_near(row: LimitUse) -> bool:
    whole = row.allowed is not None and row.used >= _NEARLY * row.allowed
    return whole or (row.host != "" and row.host_used >= _NEARLY * row.host_allowed)


def _cells(row: LimitUse, host_in_words: HostInWords) -> list[str]:
    shown = _bytes if row.resource.startswith("bytes ") else "{:,}".format
    cells = [shown(row.used) + ("" if row.allowed is None else f" of {shown(row.allowed)}")]
    if row.host:
        cells.append(f"{host_in_words(row.host)}: {shown(row.host_used)} of {shown(row.host_allowed)}")
    return [*cells, f"({row.setting})"] if row.setting else cells


def _bytes(number: int) -> str:
    return next((f"{number / size:.1f} {unit}" for unit, size in _UNITS if number >= size), f"{number} B")
