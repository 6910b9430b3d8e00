"""Switch monitors for a limited time: disable them, or bring them from shadow mode into force until confirmed.

1. The time is stored before its monitor is switched, and survives restarts.
2. Switching back can be refused, because the monitor now shares variables with others. It is then tried again.
"""

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping

import msgspec
import structlog

from appliance.specifications.specification_files import SpecificationsRefusedError
from appliance.specifications.switches import Switch
from appliance.store.ends import EndKind, EndTable
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError

LONGEST = 30 * 86_400.0
"""The longest time of a switch, in seconds."""

TIMED = EndKind("timed switch")
_SETTING = "monitor returns"
_log = structlog.get_logger()


class _Return(msgspec.Struct, frozen=True):
    """After the switch `of`, `back` applies."""

    back: Switch
    of: Switch = False


class TimedSwitches:
    """The time limits of switches; `come_back(back)` is called at the end of a limit, and calls `end`."""

    def __init__(
        self,
        store: StateStore,
        ends: EndTable,
        come_back: Callable[[Mapping[str, Switch]], Awaitable[None]],
    ) -> None:
        self._store = store
        self._ends = ends
        self._come_back = come_back
        self._kept: dict[str, _Return] = {}
        self._task: asyncio.Task[None] | None = None

    def __contains__(self, name: str) -> bool:
        return name in self._kept

    def until(self, name: str) -> float | None:
        return self._end_of(name, False)

    def confirm_by(self, name: str) -> float | None:
        return self._end_of(name, True)

    def lasting(self, name: str, now: Switch) -> Switch:
        """Return the switch after the limit of the monitor, which is `now` without a limit."""
        return self._kept[name].back if name in self._kept else now

    def unconfirmed(self) -> list[str]:
        return [name for name, one in self._kept.items() if one.of is True]

    def _end_of(self, name: str, of: Switch) -> float | None:
        found = self._kept.get(name)
        return self._ends.date(TIMED, name) if found is not None and found.of == of else None

    def start(self, states: Mapping[str, Switch]) -> None:
        text = self._store.settings().get(_SETTING, "{}")
        kept = msgspec.json.decode(text, type=dict[str, _Return])
        self._kept = {name: one for name, one in kept.items() if states.get(name) == one.of}
        self._save()
        for name in self._kept.keys() - set(self._ends.names(TIMED)):
            self._ends.set(TIMED, name, 0.0)
        self._ends.when_due(TIMED, self._due)

    def begin(self, back: Mapping[str, Switch], seconds: float, of: Switch = False) -> None:
        """Begin limits. A monitor that already has a limit returns to the switch of that limit."""
        self._kept = self._kept | {
            name: _Return(self._kept[name].back if name in self._kept else to, of)
            for name, to in back.items()
        }
        with self._store.database.together():
            for name in back:
                self._ends.set(TIMED, name, seconds)
            self._save()

    def end(self, names: Iterable[str]) -> None:
        ended = self._kept.keys() & set(names)
        if ended:
            self._kept = {name: one for name, one in self._kept.items() if name not in ended}
            self._save()

    def keep(self, states: Mapping[str, Switch]) -> None:
        self.end([name for name, one in self._kept.items() if states.get(name) != one.of])

    def undo(self) -> Callable[[], None]:
        """Return a function that sets the limits as they are now."""
        kept, restore_ends = self._kept, self._ends.undo(TIMED)

        def restore() -> None:
            self._kept = kept
            restore_ends()
            self._save()

        return restore

    def _save(self) -> None:
        self._store.save_setting(_SETTING, msgspec.json.encode(self._kept).decode())
        self._ends.forget(TIMED, *(name for name in self._ends.names(TIMED) if name not in self._kept))

    def _due(self, names: list[str]) -> None:
        if self._task is None or self._task.done():
            back = {name: self._kept[name].back for name in names}
            self._task = asyncio.get_running_loop().create_task(self._bring_back(back))

    async def _bring_back(self, due: Mapping[str, Switch]) -> None:
        try:
            await self._come_back(due)
        except SpecificationsRefusedError as error:
            _log.error("a monitor cannot be switched back yet", monitors=list(due), error=str(error))
            return
        except StoreError as error:
            _log.error(
                "a monitor is switched back, but this is not saved", monitors=list(due), reason=str(error)
            )
        self.end(due)
