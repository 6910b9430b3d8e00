from collections.abc import Callable

from appliance.store.ends import EndKind, EndTable
from appliance.store.revisions import Revisions
from appliance.store.state_file import MonitorRevisionRow, StateStore
from tests.support.ends import Ending


def row(revision: int) -> MonitorRevisionRow:
    return MonitorRevisionRow(revision, "{}", float(revision), "ann", "")


def unconfirmed(kind: EndKind) -> Callable[[StateStore, EndTable], Ending]:
    """Return the owner of changes that are not confirmed: revision 8 goes back to 7."""

    class Kept(Revisions[MonitorRevisionRow]):
        refusal = outdated = LookupError
        unconfirmed = kind

        async def _go_back(self, revision: int) -> None:
            self._put_in_force(row(revision))

        def change(self, within: float) -> None:
            self._put_in_force(row(8), within)

    def owner(store: StateStore, ends: EndTable) -> Ending:
        revisions = Kept(store, ends, store.monitor_revisions, store.save_monitor_revision, row(7))
        return Ending(revisions.change, lambda: revisions.confirm_by is not None)

    return owner
