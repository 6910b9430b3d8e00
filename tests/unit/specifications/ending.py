import contextlib
from collections.abc import Sequence

from appliance.channel.admin import MonitorSwitch
from appliance.master.reconcile.reminders import RelayMoves
from appliance.specifications.allocation import Allocation
from appliance.specifications.specification_files import CheckedSpecifications
from appliance.specifications.specification_manager import TIMED, SpecificationManager
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.control_parts import Records
from tests.support.ends import Ending, Endings
from tests.support.idle import idle
from tests.unit.store.unconfirmed import unconfirmed


async def at_once() -> None: ...


async def gun(*_order: object) -> CheckedSpecifications:
    nothing: dict[str, frozenset[str]] = {"gun": frozenset()}
    return CheckedSpecifications(monitors={"gun": "gun.rv"}, topics=nothing, services=nothing)


async def parts(_compiled: bytes, wanted: Sequence[object]) -> list[bytes]:
    return [b"" for _part in wanted]


def disabled_monitor(store: StateStore, ends: EndTable) -> Ending:
    monitors = SpecificationManager(
        None, "all", store, ends, Records(), on_fault="drop", slices=1, allocation=Allocation(1),
        relays=idle(RelayMoves, carried_out=at_once), published=lambda: None, told=[], site_keys=(),
        check=gun, check_at_start=gun, try_out=gun, parts=parts, live=dict,
    )  # fmt: skip
    with contextlib.suppress(StopIteration):
        monitors.start(restarted=True).send(None)  # nothing of it waits
    return Ending(
        lambda seconds: monitors.switch(MonitorSwitch(["gun"], False, for_seconds=seconds), "ann"),
        lambda: monitors.until("gun") is not None,
    )


ENDINGS: Endings = {
    TIMED: disabled_monitor,  # before `unconfirmed`, of whose kind it is the owner in control
    SpecificationManager.unconfirmed: unconfirmed(SpecificationManager.unconfirmed),
}
