from typing import Any

import pytest

from appliance.audit.log.record import AuditRecord
from appliance.channel import admin
from appliance.control.errors import UnknownThingError
from appliance.features.standby import requests as standby_requests
from appliance.features.standby.answers import StandbyState
from appliance.features.standby.lease_client import HandOverError
from appliance.features.standby.orders import SingleAppliance, StandbyAdministration, StandbyOrders
from tests.support.answers import example
from tests.support.core import FakeTrail

pytestmark = pytest.mark.anyio


class Pair:
    def __init__(self, role: str) -> None:
        self.role = role
        self.refusal = ""
        self.did: list[str] = []
        self.trail = FakeTrail(self._recorded, lambda: self.did.append("on disk"))

    def _recorded(self, record: AuditRecord) -> None:
        self.did.append(f"{record.event} by {record.detail['who']}: {record.reason}")

    def state(self) -> StandbyState:
        other = {"name": "b", "address": "10.0.0.2"}
        return example(StandbyState, name="a", role=self.role, other=other)

    async def hand_over(self) -> None:
        if self.refusal:
            raise HandOverError(self.refusal)
        self.did.append("handed over")
        self.role = "standby" if self.role == "active" else "active"

    def orders(self) -> StandbyOrders:
        return StandbyOrders(self, self.trail)


async def test_the_order_is_on_disk_before_the_switchover() -> None:
    pair = Pair("active")
    after = await pair.orders().promote(standby_requests.StandbyPromote(), "alice")
    assert after.role == "standby"
    assert pair.did == [
        "switchover ordered by alice: b (10.0.0.2) is to become the active appliance",
        "on disk",
        "handed over",
    ]


async def test_a_failed_switchover_is_recorded_with_its_reason() -> None:
    pair = Pair("active")
    pair.refusal = "b does not have all changes"
    with pytest.raises(HandOverError, match="b does not have all changes"):
        await pair.orders().promote(standby_requests.StandbyPromote(), "alice")
    assert pair.did[1:] == ["on disk", "switchover failed by alice: b does not have all changes", "on disk"]
    assert (await pair.orders().state(standby_requests.StandbyWanted())).role == "active"


@pytest.mark.parametrize("request_", [standby_requests.StandbyWanted(), standby_requests.StandbyPromote()])
async def test_a_single_appliance_says_how_it_gets_a_standby(request_: Any) -> None:
    pair = Pair("active")
    orders = StandbyOrders(SingleAppliance(), pair.trail)
    with pytest.raises(UnknownThingError, match="rosrv standby join"):
        await (
            orders.state(request_)
            if isinstance(request_, standby_requests.StandbyWanted)
            else orders.promote(request_, "alice")
        )
    assert pair.did == []


async def test_a_standby_answers_nothing_else() -> None:
    pair = Pair("standby")
    handler = StandbyAdministration(pair, orders=True)
    requests: list[admin.AdminRequest[Any]] = [
        admin.StatusWanted(), admin.MetricsWanted(), admin.PolicyReload(), admin.TokenList()
    ]  # fmt: skip
    for request in requests:
        answer = await handler.carry_out(request, who="operator")
        assert (answer.ok, answer.trouble, answer.active) == (False, "standby", "10.0.0.2"), request
        assert answer.error == "this appliance is the standby of b (10.0.0.2); give the command there"
    assert (await handler.carry_out(standby_requests.StandbyWanted(), who="operator")).given() == pair.state()
    assert pair.did == []


async def test_only_the_admin_socket_of_a_standby_orders_a_switchover() -> None:
    pair = Pair("standby")
    over_rest = StandbyAdministration(pair, orders=False)
    assert (await over_rest.carry_out(standby_requests.StandbyPromote(), who="alice")).trouble == "standby"
    assert pair.did == []
    handler = StandbyAdministration(pair, orders=True)
    pair.refusal = "give the order on the active appliance"
    answer = await handler.carry_out(standby_requests.StandbyPromote(), who="operator")
    assert (answer.trouble, answer.error) == ("failed", pair.refusal)
    pair.refusal = ""
    assert (
        await handler.carry_out(standby_requests.StandbyPromote(), who="operator")
    ).given().role == "active"
