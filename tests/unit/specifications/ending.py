from collections.abc import Mapping

from appliance.specifications.specifications_in_force import SpecificationsInForce
from appliance.specifications.switches import Switch
from appliance.specifications.timed_switches import TIMED, TimedSwitches
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.ends import Ending, Endings
from tests.unit.store.unconfirmed import unconfirmed


def disabled_monitor(store: StateStore, ends: EndTable) -> Ending:
    async def come_back(back: Mapping[str, Switch]) -> None:
        assert back == {"gun": True}

    switches = TimedSwitches(store, ends, come_back)
    switches.start({"gun": False})
    return Ending(lambda seconds: switches.begin({"gun": True}, seconds), lambda: "gun" in switches)


ENDINGS: Endings = {
    TIMED: disabled_monitor,
    SpecificationsInForce.unconfirmed: unconfirmed(SpecificationsInForce.unconfirmed),
}
