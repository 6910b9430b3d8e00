from appliance.features.tunnels.enrolment_tokens import ENROLMENT, EnrolmentTokens
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.ends import Ending


class AwaitedHost(Ending):
    kind = ENROLMENT

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        super().__init__(store, ends)
        self.tokens = EnrolmentTokens(store.hosts, ends)

    async def begin(self, seconds: float) -> None:
        self.tokens.add("ocu", seconds=seconds, address="10.99.0.9", days=1.0, kit={}, who="ann")

    def lasts(self) -> bool:
        return "ocu" in self.tokens.rows()
