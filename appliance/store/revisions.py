"""What the revisions of the policy and of the specifications have in common: a way back, and a time limit on it."""

import asyncio
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import structlog

from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError

_log = structlog.get_logger()
_AGAIN_SECONDS = 5.0


class Numbered(Protocol):
    """A revision that is kept."""

    @property
    def revision(self) -> int:
        """Its number."""


N = TypeVar("N", bound=Numbered)


class UnknownRevisionError(Exception):
    """There is no such revision; the text says which there are."""


def wanted(rows: Sequence[N], revision: int | None, present: int) -> N:
    """A kept revision (None: the one before the present). Raises `UnknownRevisionError`."""
    known = {row.revision: row for row in rows}
    number = revision if revision is not None else max((node for node in known if node < present), default=0)
    if number not in known:
        kept = ", ".join(map(str, sorted(known))) or "none"
        asked = "before this one" if revision is None else revision
        raise UnknownRevisionError(f"there is no revision {asked}; kept are: {kept}")
    return known[number]


@dataclass(slots=True)
class Trial:
    """A change that goes back by itself unless it is confirmed, over restarts of control and of the appliance.

    `setting` is the name under which the store has it. `go_back(revision)` brings that revision into force; where it
    raises one of `refusals`, it is called again after `_AGAIN_SECONDS`: nobody is there who could do it by hand.
    """

    store: StateStore
    setting: str
    go_back: Callable[[int], Awaitable[object]]
    refusals: tuple[type[Exception], ...]
    task: asyncio.Task[None] | None = None
    confirm_by: float | None = None  # seconds since the epoch
    _back_to: int = 0  # the last revision that needed no confirmation

    def announce(self, present: int, within: float | None) -> None:
        """A change comes; it is in the store before the revision is: control may die while the change is made."""
        if within is not None:
            self._save(self._target(present), time.time() + within, within)

    def changed(self, before: int, within: float | None) -> None:
        """The change is made: `before` was in force. Without `within` seconds nothing waits any more."""
        back_to = self._target(before)
        self.end()
        if within is not None:
            self._await(back_to, time.time() + within, within)

    def end(self) -> None:
        """What is in force stays."""
        if self.task is not None and self.task is not asyncio.current_task():
            self.task.cancel()
        self.task = self.confirm_by = None
        self.store.save_setting(self.setting, "")

    def resume(self) -> None:
        """Go on waiting after a start."""
        kept = self.store.settings().get(self.setting, "")
        if kept:
            back_to, deadline, length = (*kept.split(), "inf")[:3]  # up to 0.1.0 the length was not kept
            within = float(length)
            # Not later than after its whole length: the clock may have been set back since.
            self._await(int(back_to), min(float(deadline), time.time() + within), within)

    def _target(self, present: int) -> int:
        return present if self.confirm_by is None else self._back_to

    def _save(self, back_to: int, deadline: float, within: float) -> None:
        self.store.save_setting(self.setting, f"{back_to} {deadline} {within}")

    def _await(self, back_to: int, deadline: float, within: float) -> None:
        self._back_to, self.confirm_by = back_to, deadline
        self._save(back_to, deadline, within)
        self.task = asyncio.get_running_loop().create_task(self._run(back_to, deadline))

    async def _run(self, back_to: int, deadline: float) -> None:
        await asyncio.sleep(max(0.0, deadline - time.time()))
        while True:
            try:
                await self.go_back(back_to)
            except self.refusals as error:
                _log.error("an unconfirmed change cannot go back yet", revision=back_to, error=str(error))
                await asyncio.sleep(_AGAIN_SECONDS)
            except StoreError as error:
                _log.error("an unconfirmed change went back, and this is not kept", reason=str(error))
                return
            else:
                return
