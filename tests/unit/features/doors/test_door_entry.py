from types import SimpleNamespace

import pytest

from appliance.features.doors.door_rows import DoorRow
from appliance.features.doors.orders import DoorOrders
from appliance.policy.model import Address
from tests.support.core import FakeTrail

ALICE = DoorRow("alice", "198.19.240.2", 1.0, None, 0, None, "")


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
    peer: str, ticket: str, status: int, decision: str | None
) -> None:
    """A refusal is a denial of the peer, so those of unknown hosts are folded."""
    trail = FakeTrail()

    def blocked(host: Address) -> object | None:
        mapped = getattr(host, "ipv4_mapped", None) or host
        return object() if str(mapped) == "10.0.0.7" else None

    orders = DoorOrders.__new__(DoorOrders)
    row = SimpleNamespace(id="1")
    orders.__dict__ |= {
        "_core": SimpleNamespace(
            policy=SimpleNamespace(current=lambda: SimpleNamespace(blocked=blocked)),
            trail=trail,
        ),
        "_table": SimpleNamespace(live=lambda: [ALICE]),
        "_visits": SimpleNamespace(find=lambda _door, _text: None),
        "_tickets": SimpleNamespace(find=lambda _door, text: row if text == "valid" else None),
        "_processes": SimpleNamespace(pass_on=lambda *_given: True),
        "_used": {},
    }
    assert orders.enter("alice", ticket, peer, 3)[0] == status
    assert [(one["host"], one["decision"]) for one in trail.rows] == (
        [] if decision is None else [(peer, decision)]
    )
