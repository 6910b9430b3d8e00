from collections.abc import Iterator

import pytest

from appliance.api.front.access import TokenAuthenticator
from appliance.api.front.problems import ProblemError
from appliance.api.front.websockets import ShownTickets
from appliance.base import clock
from tests.support.virtual_clock import VirtualClock

OFFICE = "10.0.0.1"


@pytest.fixture
def machine() -> Iterator[VirtualClock]:
    with clock.using(machine := VirtualClock()):
        yield machine


@pytest.fixture
def tickets() -> ShownTickets:
    return ShownTickets(TokenAuthenticator(5, lambda _token: None))


def shown(tickets: ShownTickets, ticket: str, *, valid: bool, peer: str = OFFICE) -> int:
    """Return the status that a page gets; 101 and the second 401 are control's."""
    try:
        tickets.require(peer, "pad", ticket)
    except ProblemError as problem:
        return problem.status
    tickets.answered(peer, "pad", ticket, valid=valid)
    return 101 if valid else 401


def test_a_page_with_an_ended_ticket_keeps_no_neighbour_out(
    tickets: ShownTickets, machine: VirtualClock
) -> None:
    asked = 0
    for number in range(200):
        try:
            tickets.require(OFFICE, "pad", "ended")
        except ProblemError as problem:
            assert problem.status == 401
        else:
            asked += 1
            tickets.answered(OFFICE, "pad", "ended", valid=False)
        assert shown(tickets, f"new {number}", valid=True) == 101
        machine.advance(1.5)
    assert asked == 5  # of control, once a minute


def test_guessing_tickets_is_cut_short(tickets: ShownTickets, machine: VirtualClock) -> None:
    assert shown(tickets, "right", valid=True) == 101
    statuses = [shown(tickets, f"guess {number}", valid=False) for number in range(8)]
    assert statuses == [401] * 5 + [429] * 3
    assert shown(tickets, "right", valid=True) == 101, "it is known to be right"
    assert shown(tickets, "another", valid=True) == 429
    assert shown(tickets, "another", valid=True, peer="10.0.0.2") == 101
    machine.advance(60.0)
    assert shown(tickets, "another", valid=True) == 101


def test_a_ticket_that_has_ended_is_not_right_any_longer(
    tickets: ShownTickets, machine: VirtualClock
) -> None:
    assert shown(tickets, "one", valid=True) == 101
    assert shown(tickets, "one", valid=False) == 401
    for number in range(5):
        shown(tickets, f"guess {number}", valid=False)
    machine.advance(1.0)
    assert shown(tickets, "one", valid=False) == 401


def test_a_ticket_belongs_to_one_door(tickets: ShownTickets, machine: VirtualClock) -> None:
    assert shown(tickets, "one", valid=False) == 401
    tickets.require(OFFICE, "arm", "one")
    assert machine.now_ns() > 0


def test_a_flood_of_tickets_is_bounded(tickets: ShownTickets, machine: VirtualClock) -> None:
    for number in range(5000):
        shown(tickets, f"guess {number}", valid=False, peer=f"10.1.{number // 250}.{number % 250}")
    assert shown(tickets, "guess 4999", valid=False, peer="10.9.9.9") == 401
    assert shown(tickets, "guess 0", valid=True, peer="10.9.9.9") == 101, "the oldest is forgotten"
    assert machine.now_ns() > 0
