from appliance.control.assembly.host_blocks import BLOCKS, BlockTable
from appliance.control.assembly.policies import Policies
from appliance.policy.model import address_of
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.ends import Ending
from tests.unit.store.unconfirmed import Unconfirmed

HOST = address_of("10.0.0.66")


class Block(Ending):
    kind = BLOCKS

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        super().__init__(store, ends)
        self.blocks = BlockTable(store, ends)
        ends.when_due(BLOCKS, lambda _names: self.blocks.take(HOST))

    async def begin(self, seconds: float) -> None:
        self.blocks.put(HOST, seconds=seconds, who="ann", note="")

    def lasts(self) -> bool:
        return HOST in self.blocks.reasons


class UnconfirmedPolicy(Unconfirmed):
    kind = Policies.unconfirmed
