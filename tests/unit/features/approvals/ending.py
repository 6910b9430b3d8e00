from appliance.base import clock
from appliance.features.approvals.approval_table import (
    APPROVING,
    ApprovalEntry,
    ApprovalTable,
    ChargedHost,
    HeldCall,
)
from appliance.policy.model import Category, address_of
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.ends import Ending, Endings

CALL = HeldCall(address_of("10.0.0.7"), Category.PUBLISH, "/cmd_vel")


def approved_lease(_store: StateStore, ends: EndTable) -> Ending:
    table = ApprovalTable(17, ends)

    def begin(seconds: float) -> None:
        charged, now = ChargedHost("10.0.0.7", named=True), clock.now()
        held = table.hold(CALL, charged, now, caller_id="/n", type_="", arguments=b"", size=0)
        assert isinstance(held, ApprovalEntry)
        table.approve(held, seconds, "ann", now, credentials=frozenset({"1"}))

    def lasts() -> bool:
        entry = table.find(CALL)
        return entry is not None and table.seconds_left(entry) > 0

    return Ending(begin, lasts)


ENDINGS: Endings = {APPROVING: approved_lease}
