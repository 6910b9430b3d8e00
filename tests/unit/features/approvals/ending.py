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
from tests.support.ends import Ending

CALL = HeldCall(address_of("10.0.0.7"), Category.PUBLISH, "/cmd_vel")


class ApprovedLease(Ending):
    kind = APPROVING

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        super().__init__(store, ends)
        self.table = ApprovalTable(17, ends)

    async def begin(self, seconds: float) -> None:
        charged, now = ChargedHost("10.0.0.7", named=True), clock.now()
        held = self.table.hold(CALL, charged, now, caller_id="/n", type_="", arguments=b"", size=0)
        assert isinstance(held, ApprovalEntry)
        self.table.approve(held, seconds, "ann", now, credentials=frozenset({"1"}))

    def lasts(self) -> bool:
        entry = self.table.find(CALL)
        return entry is not None and self.table.seconds_left(entry) > 0
