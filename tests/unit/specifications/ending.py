from collections.abc import Mapping

from appliance.specifications.specification_manager import SpecificationManager
from appliance.specifications.switches import Switch
from appliance.specifications.timed_switches import TIMED, TimedSwitches
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.ends import Ending
from tests.unit.store.unconfirmed import Unconfirmed


class DisabledMonitor(Ending):
    kind = TIMED

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        super().__init__(store, ends)
        self.switches = TimedSwitches(store, ends, self._come_back)
        self.switches.start({"gun": False})

    async def begin(self, seconds: float) -> None:
        self.switches.begin({"gun": True}, seconds)

    def lasts(self) -> bool:
        return "gun" in self.switches

    async def _come_back(self, back: Mapping[str, Switch]) -> None:
        assert back == {"gun": True}


class UnconfirmedMonitors(Unconfirmed):
    kind = SpecificationManager.unconfirmed
