from typing import Any

import pytest

from appliance.audit.log.record import AuditRecord
from appliance.channel import admin
from appliance.control.errors import UnknownThingError
from appliance.features.standby import requests as standby_requests
from appliance.features.standby.lease_client import HandOverError
from appliance.features.standby.orders import StandbyAdministration, StandbyOrders
from tests.support.core import FakeTrail
from tests.unit.features.standby.parts import Member

pytestmark = pytest.mark.anyio


def orders_of(member: Member) -> StandbyOrders:
    def note(record: AuditRecord) -> None:
        member.did.append(f"{record.event} by {record.detail['who']}: {record.reason}")

    return StandbyOrders(member, FakeTrail(note, lambda: member.did.append("on disk")))


async def test_the_order_is_on_disk_before_the_switchover() -> None:
    member = Member()
    after = await orders_of(member).promote(standby_requests.StandbyPromote(), "alice")
    assert after.role == "standby"
    assert member.did == [
        "switchover ordered by alice: b (10.0.0.2) is to become the active appliance",
        "on disk",
        "handed over",
    ]


async def test_a_failed_switchover_is_recorded_with_its_reason() -> None:
    member = Member(refusal="b does not have all changes")
    with pytest.raises(HandOverError, match="b does not have all changes"):
        await orders_of(member).promote(standby_requests.StandbyPromote(), "alice")
    assert member.did[1:] == ["on disk", "switchover failed by alice: b does not have all changes", "on disk"]
    assert (await orders_of(member).state(standby_requests.StandbyWanted())).role == "active"


@pytest.mark.parametrize("request_", [standby_requests.StandbyWanted(), standby_requests.StandbyPromote()])
async def test_a_single_appliance_says_how_it_gets_a_standby(request_: Any) -> None:
    trail = FakeTrail()
    orders = StandbyOrders(None, trail)
    with pytest.raises(UnknownThingError, match="rosrv standby join"):
        await (
            orders.state(request_)
            if isinstance(request_, standby_requests.StandbyWanted)
            else orders.promote(request_, "alice")
        )
    assert trail.events == []


async def test_a_standby_answers_nothing_else() -> None:
    member = Member("standby")
    handler = StandbyAdministration(member, orders=True)
    requests: list[admin.AdminRequest[Any]] = [
        admin.StatusWanted(), admin.MetricsWanted(), admin.PolicyReload(), admin.TokenList()
    ]  # fmt: skip
    for request in requests:
        answer = await handler.carry_out(request, who="operator")
        assert (answer.ok, answer.trouble, answer.active) == (False, "standby", "10.0.0.2"), request
        assert answer.error == "this appliance is the standby of b (10.0.0.2); give the command there"
    assert (
        await handler.carry_out(standby_requests.StandbyWanted(), who="operator")
    ).unwrap() == member.state()
    assert member.did == []


async def test_only_the_admin_socket_of_a_standby_orders_a_switchover() -> None:
    member = Member("standby")
    over_rest = StandbyAdministration(member, orders=False)
    assert (await over_rest.carry_out(standby_requests.StandbyPromote(), who="alice")).trouble == "standby"
    assert member.did == []
    handler = StandbyAdministration(member, orders=True)
    member.refusal = "give the order on the active appliance"
    answer = await handler.carry_out(standby_requests.StandbyPromote(), who="operator")
    assert (answer.trouble, answer.error) == ("failed", member.refusal)
    member.refusal = ""
    assert (
        await handler.carry_out(standby_requests.StandbyPromote(), who="operator")
    ).unwrap().role == "active"
