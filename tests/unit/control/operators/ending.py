from appliance.channel.admin import TokenAdd
from appliance.channel.answers.status import Status
from appliance.control.operators.handled_alarms import SILENCES, HandledAlarms
from appliance.control.operators.token_orders import TOKENS, TokenOrders
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.answers import example
from tests.support.core import FakeTrail
from tests.support.ends import Ending


class Token(Ending):
    kind = TOKENS

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        super().__init__(store, ends)
        self.tokens = TokenOrders(store, FakeTrail(), ends, lambda: None)

    async def begin(self, seconds: float) -> None:
        await self.tokens.add(TokenAdd("ann", "viewer", seconds))

    def lasts(self) -> bool:
        return bool(self.tokens.usable())


class Silence(Ending):
    kind = SILENCES

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        super().__init__(store, ends)
        self.handled = HandledAlarms(store, ends)

    async def begin(self, seconds: float) -> None:
        self.handled.silence("rosmaster", "ann", "", seconds)

    def lasts(self) -> bool:
        return bool(self.handled.marked(example(Status)).handled_alarms)
