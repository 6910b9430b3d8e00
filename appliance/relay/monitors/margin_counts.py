"""How close the comparisons of the monitors came: since they were loaded, and today (UTC).

Every message counts: the modules note it (`rosmop/compile/margins.py`), and once a second that is taken from there. So
the times are those of the second; of monitors on trial only the messages count that they were given.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

from appliance.channel.messages import Approach, MarginRow

if TYPE_CHECKING:
    from rosmop.run.engine import Margin, MonitorSet

_DAY = 86_400 * 1_000_000_000


@dataclass(slots=True)
class _Closest:
    margin: Margin
    load: Approach
    today: Approach


class Margins:
    """Takes them from the monitors; `rows` has those of a monitor, in the order of the text."""

    def __init__(self) -> None:
        self._closest: dict[str, dict[tuple[int, bool], _Closest]] = {}

    def keep(self, names: Collection[str], began: Collection[str]) -> None:
        """These monitors are in force or on trial now; those that began do so without what was before them."""
        self._closest = {
            name: closest for name, closest in self._closest.items() if name in names and name not in began
        }

    def take(self, monitors: MonitorSet, time: int) -> None:
        """Take what came since the last time (nanoseconds since the epoch)."""
        for part in (monitors, *monitors.trials):
            for margin in part.take_margins():
                self._take(margin, Approach(margin.left, margin.right, time))

    def _take(self, margin: Margin, now: Approach) -> None:
        of_monitor = self._closest.setdefault(margin.monitor, {})
        key = (margin.number, not margin.holds)
        before = of_monitor.get(key)
        if before is None:
            of_monitor[key] = _Closest(margin, now, now)
            return
        if now.distance < before.load.distance:
            before.load = now
        if now.distance < before.today.distance or now.time // _DAY != before.today.time // _DAY:
            before.today = now

    def rows(self, monitor: str, time: int) -> list[MarginRow]:
        """How close those of a monitor came, as of this time."""
        return [
            MarginRow(
                closest.margin.position.line,
                closest.margin.position.column,
                closest.margin.holds,
                closest.margin.threshold,
                closest.load,
                closest.today if closest.today.time // _DAY == time // _DAY else None,
            )
            for _key, closest in sorted(self._closest.get(monitor, {}).items())
        ]
