from collections.abc import Callable

from appliance.store.ends import EndTable
from appliance.store.revisions import Revisions
from appliance.store.state_file import MonitorRevisionRow, StateStore
from tests.support.ends import Ending


def row(revision: int) -> MonitorRevisionRow:
    return MonitorRevisionRow(revision, "{}", float(revision), "ann", "")


class Unconfirmed(Ending):
    """A change that is not confirmed: revision 8 goes back to 7."""

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        super().__init__(store, ends)
        kind = self.kind

        class Kept(Revisions[MonitorRevisionRow]):
            refusal = outdated = LookupError
            unconfirmed = kind

            async def _go_back(self, revision: int) -> None:
                self._put_in_force(row(revision))

            def change(self, within: float) -> None:
                self._put_in_force(row(8), within)

        revisions = Kept(store, ends, store.monitor_revisions, store.save_monitor_revision, row(7))
        self.change: Callable[[float], None] = revisions.change
        self.revisions: Revisions[MonitorRevisionRow] = revisions

    async def begin(self, seconds: float) -> None:
        self.change(seconds)

    def lasts(self) -> bool:
        return self.revisions.confirm_by is not None
