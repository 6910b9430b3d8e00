from appliance.control.assembly.host_blocks import BLOCKS, BlockTable
from appliance.control.assembly.policies import Policies
from appliance.policy.model import address_of
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.ends import Ending, Endings
from tests.unit.store.unconfirmed import unconfirmed

HOST = address_of("10.0.0.66")


def block(store: StateStore, ends: EndTable) -> Ending:
    blocks = BlockTable(store, ends)
    ends.when_due(BLOCKS, lambda _names: blocks.take(HOST))
    return Ending(
        lambda seconds: blocks.put(HOST, seconds=seconds, who="ann", note=""),
        lambda: HOST in blocks.reasons,
    )


ENDINGS: Endings = {BLOCKS: block, Policies.unconfirmed: unconfirmed(Policies.unconfirmed)}
