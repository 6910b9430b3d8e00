from appliance.base import clock
from appliance.features.sso.control_part import ONLINE, SessionTable
from appliance.features.sso.link import SessionKeys, SignedInPerson
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.ends import Ending, Endings

ID = "0123456789ab"


def session(_store: StateStore, ends: EndTable) -> Ending:
    sessions = SessionTable(ends, lambda: None)

    def begin(seconds: float) -> None:
        person = SignedInPerson("u-1", "alice", "", "operator", (), clock.wall() + seconds)
        sessions.open(person, SessionKeys(ID, b"r" * 32, b"v" * 32))

    return Ending(begin, lambda: sessions.of(ID) is not None)


ENDINGS: Endings = {ONLINE: session}
