from appliance.channel.admin import TokenAdd
from appliance.channel.answers.status import Status
from appliance.control.operators.handled_alarms import SILENCES, HandledAlarms
from appliance.control.operators.token_orders import TOKENS, TokenOrders
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.answers import example
from tests.support.core import FakeTrail
from tests.support.ends import Ending, Endings


def token(store: StateStore, ends: EndTable) -> Ending:
    tokens = TokenOrders(store, FakeTrail(), ends, lambda: None)
    return Ending(
        lambda seconds: tokens.add(TokenAdd("ann", "viewer", seconds)), lambda: bool(tokens.usable())
    )


def silence(store: StateStore, ends: EndTable) -> Ending:
    handled = HandledAlarms(store, ends)
    return Ending(
        lambda seconds: handled.silence("rosmaster", "ann", "", seconds),
        lambda: bool(handled.with_marks(example(Status)).handled_alarms),
    )


ENDINGS: Endings = {TOKENS: token, SILENCES: silence}
