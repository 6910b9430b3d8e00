from appliance.features.tunnels.enrolment_tokens import ENROLMENT, EnrolmentTokens
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.ends import Ending, Endings


def awaited_host(store: StateStore, ends: EndTable) -> Ending:
    tokens = EnrolmentTokens(store.hosts, ends)
    return Ending(
        lambda seconds: tokens.add("ocu", seconds=seconds, address="10.99.0.9", days=1.0, kit={}, who="ann"),
        lambda: "ocu" in tokens.rows(),
    )


ENDINGS: Endings = {ENROLMENT: awaited_host}
