"""Store and list revisions, roll back to a revision, and roll back changes that are not confirmed in time."""

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import structlog

from appliance.base.actors import DISK
from appliance.base.withdrawal import require_awaited
from appliance.store.ends import EndKind, EndTable
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError

_log = structlog.get_logger()


def reloaded_by(who: str) -> str:
    return "reloaded from disk" + (f" by {who}" if who != DISK else "")


class Row(Protocol):
    """A stored revision."""

    @property
    def revision(self) -> int:
        """The revision's number; 0 before the first revision."""

    @property
    def who(self) -> str:
        """The operator who brought the revision into force, or `DISK`."""

    def _asdict(self) -> dict[str, Any]: ...


R = TypeVar("R", bound=Row)


class Revisions(ABC, Generic[R]):
    """The revisions of the policy or of the specifications; only one change is made at a time.

    An unconfirmed change is rolled back even if the appliance restarts, with all later ones: only a confirmation, and a
    rollback to a revision before it, end the time to confirm, because who makes another change may not know of it. A
    rollback that raises `refusal` or `StoreError` changes nothing, and is tried again, because the operators may be
    absent.
    """

    refusal: ClassVar[type[Exception]]
    """The error for a revision that cannot come into force; it takes findings."""
    outdated: ClassVar[type[Exception]]
    """The error for a change that expected another tag; it takes the expected tag and the present one."""
    unconfirmed: ClassVar[EndKind]
    """The end of the time to confirm. Its name is the number of the last revision that needed no confirmation."""

    def __init__(
        self,
        store: StateStore,
        ends: EndTable,
        rows: Callable[..., list[R]],
        save: Callable[[R], None],
        nothing: R,
    ) -> None:
        """`rows(limit)` returns revisions, newest first; `nothing` is in force until the last one is loaded."""
        self.store = store
        self.ends = ends
        self._rows = rows
        self._save = save
        self._one_change = asyncio.Lock()
        self.in_force = nothing
        self.going_back: asyncio.Task[None] | None = None
        ends.when_due(self.unconfirmed, self._due)

    @property
    def revision(self) -> int:
        return self.in_force.revision

    @property
    def tag(self) -> int | str:
        return self.revision

    @property
    def confirm_by(self) -> float | None:
        """Return the end of the time to confirm, in seconds since the epoch, or None."""
        return next(
            (self.ends.date(self.unconfirmed, name) for name in self.ends.names(self.unconfirmed)), None
        )

    @property
    def unless_confirmed(self) -> str:
        """Return in words what comes into force without a confirmation; empty if nothing waits for one."""
        back_to = self.ends.names(self.unconfirmed)
        return f"; without a confirmation, revision {back_to[0]} returns" if back_to else ""

    def settles(self, revision: int) -> bool:
        """Return whether nothing waits for a confirmation after a rollback to this revision."""
        return all(revision <= int(back_to) for back_to in self.ends.names(self.unconfirmed))

    @abstractmethod
    async def _go_back(self, revision: int) -> None:
        """Bring the former revision into force again, because the present one was not confirmed in time."""

    # --- start ---

    def find_last(self, *, restarted: bool) -> bool:
        """Return whether the last stored revision takes precedence over the files on disk.

        It does after a crash of control (`restarted`), or if an operator made it.
        """
        self.in_force = next(iter(self._rows(1)), self.in_force)
        return self.revision > 0 and (restarted or self.in_force.who != DISK)

    # --- reading ---

    async def rows(self) -> list[R]:
        return await asyncio.to_thread(self._rows)

    def describe(self, row: R) -> dict[str, Any]:
        return row._asdict() | {"in_force": row.revision == self.revision}

    async def find(self, revision: int) -> R | None:
        return next((row for row in await self.rows() if row.revision == revision), None)

    async def require(self, revision: int | None) -> R:
        """Return a stored revision; None is the revision before the present one. Raises `refusal` and `outdated`."""
        before = self.revision
        known = {row.revision: row for row in await self.rows()}
        if self.revision != before:
            raise self.outdated(before, self.revision)
        previous = max((number for number in known if number < before), default=0)
        row = known.get(previous if revision is None else revision)
        if row is None:
            kept = ", ".join(map(str, sorted(known))) or "none"
            asked = "before this one" if revision is None else revision
            raise self.refusal([f"there is no revision {asked}; kept are: {kept}"])
        return row

    # --- changing ---

    @contextlib.asynccontextmanager
    async def changing(self, expected: int | str | None) -> AsyncIterator[None]:
        """Make no other change during the block. Raises `outdated` unless `expected` is None or the present tag."""
        async with self._one_change:
            require_awaited()
            if expected not in (None, self.tag):
                raise self.outdated(expected, self.tag)
            yield

    def _put_in_force(self, row: R, within: float | None = None, *, settled: bool = False) -> None:
        """Store a revision. `within` is a new time limit to confirm it, in seconds; a `settled` one has none."""
        back_to = next(iter(self.ends.names(self.unconfirmed)), str(self.revision))
        with self.store.database.together():  # control may die during the change
            if settled or within is not None:
                self.end_limit()
            if within is not None:
                self.ends.set(self.unconfirmed, back_to, within)
            self._save(row)
        self.in_force = row

    def end_limit(self) -> None:
        self._cancel_return()
        self.ends.forget(self.unconfirmed, *self.ends.names(self.unconfirmed))

    def _cancel_return(self) -> None:
        if self.going_back is not None and self.going_back is not asyncio.current_task():
            self.going_back.cancel()
        self.going_back = None

    def _due(self, revisions: list[str]) -> None:
        if self.going_back is None or self.going_back.done():
            self.going_back = asyncio.get_running_loop().create_task(self._run(int(revisions[0])))

    async def _run(self, back_to: int) -> None:
        try:
            await self._go_back(back_to)
        except (self.refusal, StoreError) as error:
            if self.confirm_by is None:  # the rollback was complete before the error
                _log.error("an unconfirmed change was rolled back, but this is not saved", reason=str(error))
            else:  # `EndTable` calls again
                _log.error(
                    "an unconfirmed change cannot be rolled back yet", revision=back_to, error=str(error)
                )
