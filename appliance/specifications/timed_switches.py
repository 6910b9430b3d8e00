"""Switch monitors for a limited time: disable them, or bring them from shadow mode into force until confirmed.

1. The time is stored before its monitor is switched, and survives restarts.
2. A monitor is switched for at most the ordered time plus the time for which the appliance did not run, even if
   the clock was set back.
3. Switching back can be refused, because the monitor now shares variables with others. It is then tried again.
"""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Iterable, Mapping

import msgspec
import structlog

from appliance.base import clock
from appliance.base.deadlines import Deadlines
from appliance.specifications.rollout import Switch
from appliance.specifications.specification_files import SpecificationsRefusedError
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError

LONGEST = 30 * 86_400.0
"""The longest time of a switch, in seconds."""

_SETTING = "monitor returns"
_AGAIN_SECONDS = 5.0
_log = structlog.get_logger()


class _Return(msgspec.Struct, frozen=True):
    """The switch `of` ends at `until` (seconds since the epoch), after `seconds`; then `back` applies."""

    until: float
    seconds: float
    back: Switch
    of: Switch = False


def returns_moved(store: StateStore, seconds: float) -> None:
    kept = msgspec.json.decode(store.settings().get(_SETTING, "{}"), type=dict[str, _Return])
    moved = {name: msgspec.structs.replace(one, until=one.until + seconds) for name, one in kept.items()}
    store.save_setting(_SETTING, msgspec.json.encode(moved).decode())


class TimedSwitches:
    """The time limits of switches; `come_back(back)` is called at the end of a limit, and calls `end`."""

    def __init__(
        self, store: StateStore, come_back: Callable[[Mapping[str, Switch]], Awaitable[None]]
    ) -> None:
        self._store = store
        self._come_back = come_back
        self._kept: dict[str, _Return] = {}
        self._ends = Deadlines()
        self._changed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    def __contains__(self, name: str) -> bool:
        return name in self._kept

    def until(self, name: str) -> float | None:
        return self._end_of(name, False)

    def confirm_by(self, name: str) -> float | None:
        return self._end_of(name, True)

    def unconfirmed(self) -> list[str]:
        return [name for name, one in self._kept.items() if one.of is True]

    def _end_of(self, name: str, of: Switch) -> float | None:
        found = self._kept.get(name)
        return found.until if found is not None and found.of == of else None

    def start(self, states: Mapping[str, Switch]) -> None:
        text = self._store.settings().get(_SETTING, "{}")
        kept = msgspec.json.decode(text, type=dict[str, _Return])
        now = clock.wall()
        self._kept = {
            name: msgspec.structs.replace(one, until=min(one.until, now + one.seconds))
            for name, one in kept.items()
            if states.get(name) == one.of
        }
        self._save()

    def begin(self, back: Mapping[str, Switch], seconds: float, of: Switch = False) -> None:
        """Begin limits. A monitor that already has a limit returns to the switch of that limit."""
        until = clock.wall() + seconds
        self._kept |= {
            name: _Return(until, seconds, self._kept[name].back if name in self._kept else to, of)
            for name, to in back.items()
        }
        self._save()

    def end(self, names: Iterable[str]) -> None:
        ended = self._kept.keys() & set(names)
        if ended:
            self._kept = {name: one for name, one in self._kept.items() if name not in ended}
            self._save()

    def keep(self, states: Mapping[str, Switch]) -> None:
        self.end([name for name, one in self._kept.items() if states.get(name) != one.of])

    def _save(self) -> None:
        self._store.save_setting(_SETTING, msgspec.json.encode(self._kept).decode())
        self._changed.set()
        if self._kept and (self._task is None or self._task.done()):
            self._task = asyncio.get_running_loop().create_task(self._run())

    async def _run(self) -> None:
        while self._kept:
            due = {name: one.back for name, one in self._kept.items() if self._ends.passed(name, one.until)}
            if due:
                await self._bring_back(due)
                continue
            self._changed.clear()
            left = min(seconds for name, seconds in self._ends.left().items() if name in self._kept)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(left):
                    await self._changed.wait()

    async def _bring_back(self, due: Mapping[str, Switch]) -> None:
        try:
            await self._come_back(due)
        except SpecificationsRefusedError as error:
            _log.error("a monitor cannot be switched back yet", monitors=list(due), error=str(error))
            await asyncio.sleep(_AGAIN_SECONDS)
            return
        except StoreError as error:
            _log.error(
                "a monitor is switched back, but this is not saved", monitors=list(due), reason=str(error)
            )
        self.end(due)
