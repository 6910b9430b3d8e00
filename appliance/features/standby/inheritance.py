"""Pass the state of monitors from one appliance to the other.

The replicated setting `active appliance` names the appliance and epoch whose relays passed the last messages. It
is stored only after all relays have taken the inherited state, so a control that dies before repeats the
inheritance.

At an unplanned takeover, a copy is used only if it is fresh and from the last epoch. Otherwise monitors whose actions
depend on their state hold their topics. Monitors with the modifier `hold` always do, because a copy lacks the last
messages.
"""

import asyncio
from collections.abc import Callable, Iterable
from typing import Protocol

import msgspec

from appliance.base import clock
from appliance.channel.messages import StateLeft
from appliance.features.standby.lease_client import HandOverError
from appliance.features.standby.replication import Pair
from appliance.specifications.rollout import InheritedState
from appliance.store.state_file import StateStore

_ACTIVE = "active appliance"
_COPIES = "copies of monitors"
_RELAY_SECONDS = 2.0
_LEAVE_SECONDS = 1.0  # messages do not pass
_COPY_SECONDS = 0.2
_LOOK_SECONDS = 0.25
_NOTE_SECONDS = 1.0  # between two notes that the copies are up to date
_BYTES_A_SECOND = 1 << 20
_UNABLE_SECONDS = 5.0  # after a state that cannot be copied
_FRESH_SECONDS = 5.0  # includes the time of the takeover


class _Active(msgspec.Struct, frozen=True):
    name: str
    epoch: int


class _Copies(msgspec.Struct, frozen=True):
    """The stored copies of states."""

    epoch: int
    at: int
    """The time of the states (ns), or 0 if the relays passed no message since."""


class StateHolders(Protocol):
    """The relays, whose monitors have the state, as `Rollout` reaches them."""

    def has_state(self) -> bool: ...

    async def leave(self, seconds: float) -> list[bytes]: ...

    async def copies(self, seconds: float, *, full: bool) -> list[StateLeft]: ...

    def pass_again(self) -> None: ...


def _save_copies(store: StateStore, epoch: int, contents: Iterable[tuple[int, bytes]], at: int) -> None:
    with store.database.together():
        for index, content in contents:
            store.save_monitor_state(index, epoch, content)
        store.save_setting(_COPIES, msgspec.json.encode(_Copies(epoch, at)).decode())


def inherited_state(pair: Pair, store: StateStore) -> tuple[InheritedState, Callable[[], None]]:
    own = _Active(pair.membership.name, pair.epoch)

    def taken() -> None:
        with store.database.together():
            store.save_setting(_ACTIVE, msgspec.json.encode(own).decode())
            store.save_setting(_COPIES, "")
            store.clear_monitor_states()

    settings = store.settings()
    text = settings.get(_ACTIVE)
    last = msgspec.json.decode(text, type=_Active) if text is not None else own
    if last.name == own.name:
        return InheritedState(), taken
    lost = f"the appliance {last.name} was active, and its monitors' state is lost with it"
    note = settings.get(_COPIES)
    copies = msgspec.json.decode(note, type=_Copies) if note else _Copies(0, 0)
    if copies.epoch != last.epoch or last.epoch != pair.epoch - 1:
        return InheritedState(lost), taken
    left = tuple(store.monitor_states(last.epoch))
    if not copies.at:
        return InheritedState(left=left), taken
    fresh = pair.copy_age is not None and pair.copy_age <= _FRESH_SECONDS
    return InheritedState(lost, left, copies.at) if fresh else InheritedState(lost), taken


async def leave_state(pair: Pair, store: StateStore, relays: StateHolders) -> None:
    """Store the state of all monitors after their last message, before the lease is given up."""
    try:
        contents = await relays.leave(_LEAVE_SECONDS)
    except (TimeoutError, ConnectionError) as error:
        raise HandOverError("a relay does not answer; try again") from error
    _save_copies(store, pair.epoch, enumerate(contents), 0)


def keep_state(store: StateStore, relays: StateHolders) -> None:
    """Void the states that relays left for a switchover, and let messages pass again."""
    store.save_setting(_COPIES, "")
    relays.pass_again()


class StateCopies:
    """Copies the states of monitors for an unplanned takeover."""

    def __init__(
        self, pair: Pair, store: StateStore, relays: StateHolders, followed: Callable[[], bool]
    ) -> None:
        # `followed()` returns whether the standby gets changes now.
        self._epoch = pair.epoch
        self._store = store
        self._relays = relays
        self._followed = followed
        self._complete = False  # whether the stored copies are those of all relays
        self._noted = 0.0
        self._copying = asyncio.Lock()

    async def run(self) -> None:
        while True:
            await asyncio.sleep(await self.copy_once())

    async def rehearse(self) -> None:
        """Copy all states, which are as much as `leave_state` will store. Raises `HandOverError`."""
        if not self._relays.has_state():
            return
        copied = False
        try:
            async with asyncio.timeout(_LEAVE_SECONDS), self._copying:
                copies = await self._relays.copies(_LEAVE_SECONDS, full=True)
                copied = all(copy.at for copy in copies)
                if copied:  # otherwise a state cannot be copied while messages pass
                    contents = enumerate(copy.content or b"" for copy in copies)
                    _save_copies(self._store, self._epoch, contents, max(copy.at for copy in copies))
        except (TimeoutError, ConnectionError) as error:
            raise HandOverError("a relay does not answer; try again") from error
        finally:
            if not copied:  # relays that did answer send their changes only once
                self._void()

    async def copy_once(self) -> float:
        """Copy the changed states, and return the seconds until the next copy."""
        async with self._copying:
            return await self._copy_changed()

    async def _copy_changed(self) -> float:
        if not self._relays.has_state() or not self._followed():
            self._void()
            return _COPY_SECONDS
        try:
            copies = await self._relays.copies(_RELAY_SECONDS, full=not self._complete)
        except (TimeoutError, ConnectionError):
            self._void()
            return _COPY_SECONDS
        if not self._relays.has_state():  # an operator has ordered a switchover since
            return _COPY_SECONDS
        if not all(copy.at for copy in copies):
            self._void()
            return _UNABLE_SECONDS
        changed = [(index, copy.content) for index, copy in enumerate(copies) if copy.content is not None]
        if changed or clock.now() - self._noted >= _NOTE_SECONDS:
            _save_copies(self._store, self._epoch, changed, max(copy.at for copy in copies))
            self._noted = clock.now()
        self._complete = True
        size = sum(len(content) for _index, content in changed)
        return max(_COPY_SECONDS, size / _BYTES_A_SECOND)

    def _void(self) -> None:
        if self._complete:
            self._complete = False
            if self._relays.has_state():
                self._store.save_setting(_COPIES, "")


class CopyAge:
    """The time since the last note that the copies are up to date."""

    def __init__(self, setting: Callable[[str], str]) -> None:
        self._setting = setting
        self._note = setting(_COPIES)
        self._changed: float | None = None

    async def run(self) -> None:
        while True:
            self.look(await asyncio.to_thread(self._setting, _COPIES))
            await asyncio.sleep(_LOOK_SECONDS)

    def look(self, note: str) -> None:
        if note != self._note:
            self._note, self._changed = note, clock.now()

    def at(self, moment: float) -> float | None:
        return None if self._changed is None else max(0.0, moment - self._changed)
