import re
from dataclasses import replace
from pathlib import Path

import pytest

from appliance.control.errors import SenselessError
from appliance.features.doors.door_visits import DoorTickets, DoorVisits
from appliance.features.doors.orders import DoorOrders
from appliance.features.doors.requests import DoorAdd
from appliance.policy.model import address_of
from tests.unit.features.doors.door_site import DoorSite


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DoorSite:
    site = DoorSite(tmp_path, monkeypatch)
    monkeypatch.setattr(site.processes, "pass_on", lambda *_given: True)
    return site


@pytest.mark.parametrize(
    ("peer", "ticket", "status", "decision"),
    [
        ("10.0.0.8", "valid", 101, None),
        ("10.0.0.8", "wrong", 401, "deny"),
        ("10.0.0.7", "valid", 403, "deny"),
        ("::ffff:10.0.0.7", "valid", 403, "deny"),
    ],
)
def test_a_ticket_opens_a_door_for_hosts_that_are_not_blocked(
    site: DoorSite, peer: str, ticket: str, status: int, decision: str | None
) -> None:
    """A refusal is a denial of the peer, so those of unknown hosts are folded."""
    blocks = {address_of("10.0.0.7"): "by an operator"}
    site.policies.policy.set(replace(site.policies.current, blocks=blocks))
    tickets, visits = DoorTickets(site.core.store, site.core.ends), DoorVisits(site.core.ends, dict)
    orders = DoorOrders(site.core, site.table, tickets=tickets, visits=visits, processes=site.processes)
    secret = tickets.make("alice", 60.0, "ann")[1] if ticket == "valid" else "wrong"
    assert orders.enter("alice", secret, peer, 3)[0] == status
    assert [(row["host"], row["decision"]) for row in site.trail.rows] == (
        [] if decision is None else [(peer, decision)]
    )


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("port", "owner"),
    [(11311, "RVMaster"), (11399, "the ROS master"), (8443, "REST"), (19500, "[Ports] range of the policy")],
)
async def test_no_door_has_a_port_of_the_appliance(port: int, owner: str, site: DoorSite) -> None:
    """It would never listen."""
    core = site.core
    given = replace(core.settings, listen="0.0.0.0:11311", rosmaster_port=11399, api="0.0.0.0:8443")
    tickets, visits = DoorTickets(core.store, core.ends), DoorVisits(core.ends, dict)
    orders = DoorOrders(
        replace(core, settings=given), site.table, tickets=tickets, visits=visits, processes=site.processes
    )
    with pytest.raises(SenselessError, match=f"port {port} is .*{re.escape(owner)}: choose another"):
        await orders.add(DoorAdd("agent", port), "ann")
    assert (site.asked, site.trail.rows) == ([], [])
    assert [row.name for row in site.table.live()] == ["alice"]
