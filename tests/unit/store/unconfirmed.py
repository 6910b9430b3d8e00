from collections.abc import Awaitable, Callable

from appliance.store.ends import EndKind, EndTable
from appliance.store.revisions import Revisions
from appliance.store.state_file import MonitorRevisionRow, StateStore
from tests.support.ends import Ending


def row(revision: int, who: str = "eve") -> MonitorRevisionRow:
    return MonitorRevisionRow(revision, "{}", float(revision), who, "")


class Keeper(Revisions[MonitorRevisionRow]):
    """Revisions that control nothing. `back(revision)` is called when a change was not confirmed in time."""

    refusal = outdated = LookupError
    unconfirmed = EndKind("limit")

    def __init__(
        self, store: StateStore, ends: EndTable, back: Callable[[int], Awaitable[None]], first: int = 0
    ) -> None:
        self._back = back
        super().__init__(store, ends, store.monitor_revisions, store.save_monitor_revision, row(first))

    async def _go_back(self, revision: int) -> None:
        await self._back(revision)

    def change(self, to: MonitorRevisionRow, within: float | None = None, *, settled: bool = False) -> None:
        self._put_in_force(to, within, settled=settled)


def unconfirmed(kind: EndKind) -> Callable[[StateStore, EndTable], Ending]:
    """Return the owner of changes that are not confirmed: revision 8 goes back to 7."""
    keepers = type("Keeper", (Keeper,), {"unconfirmed": kind})

    def owner(store: StateStore, ends: EndTable) -> Ending:
        async def back(revision: int) -> None:
            keeper.change(row(revision), settled=True)

        keeper = keepers(store, ends, back, 7)
        return Ending(lambda within: keeper.change(row(8), within), lambda: keeper.confirm_by is not None)

    return owner
