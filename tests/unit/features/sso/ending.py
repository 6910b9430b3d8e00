from appliance.base import clock
from appliance.features.sso.link import SessionKeys, SignedInPerson
from appliance.features.sso.sessions import ONLINE, SessionTable
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.ends import Ending

ID = "0123456789ab"


class PersonsSession(Ending):
    kind = ONLINE

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        super().__init__(store, ends)
        self.sessions = SessionTable(ends, lambda: None)

    async def begin(self, seconds: float) -> None:
        person = SignedInPerson("u-1", "alice", "", "operator", (), clock.wall() + seconds)
        self.sessions.open(person, SessionKeys(ID, b"r" * 32, b"v" * 32))

    def lasts(self) -> bool:
        return self.sessions.of(ID) is not None
