import pytest

from appliance.network import vendor_masters
from appliance.network.namespaces import Namespace


def test_no_packet_that_arrives_is_left_to_the_robots_own_master(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the hook of arriving packets, the rule would match the socket of that master, for any sender."""
    ran: list[str] = []
    monkeypatch.setattr(vendor_masters, "run_nft", lambda _namespace, text: ran.append(text))
    vendor_masters.leave_alone(Namespace.own(), ("system.slice/roscore.service",))
    rules = [line for text in ran for line in text.splitlines() if "rule" in line]
    assert rules
    assert all(" ROSRV-NAT-OUTPUT " in rule for rule in rules)
    assert 'masters { "system.slice/roscore.service" }' in ran[-1]
