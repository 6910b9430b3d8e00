import socket
from collections.abc import Iterator

import pytest

from appliance.network.firewall.rule_watch import RuleWatch
from tests.support.nftables_reports import CHAIN_REMOVED, ELEMENT_ADDED, RULE_ADDED, generation, report


@pytest.fixture
def kernel(sockets: None) -> Iterator[tuple[RuleWatch, socket.socket]]:
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    here.setblocking(False)

    with here, there:
        yield RuleWatch(here, frozenset({"rosrv"})), there


def test_a_transaction_is_heard_with_its_program_once_it_is_complete(
    kernel: tuple[RuleWatch, socket.socket],
) -> None:
    watch, there = kernel
    there.send(report(CHAIN_REMOVED, "other") + report(CHAIN_REMOVED, "rosrv"))
    assert watch.changes() == []
    there.send(report(RULE_ADDED, "other") + generation("firewalld"))
    assert watch.changes() == ["firewalld"]
    there.send(report(RULE_ADDED, "other") + generation("dockerd"))
    there.send(report(ELEMENT_ADDED, "rosrv") + generation("rosrv"))
    assert watch.changes() == []


def test_a_report_that_is_not_understood_ends_nothing(kernel: tuple[RuleWatch, socket.socket]) -> None:
    watch, there = kernel
    whole = report(CHAIN_REMOVED, "rosrv") + generation("nft")
    for length in range(1, len(whole)):
        there.send(whole[:length])
        watch.changes()
        there.send(whole)
        assert watch.changes()[-1] == "nft"
