from websockets.server import ServerProtocol

from appliance.base import clock
from appliance.features.doors.door_link import MAX_SHOWN
from appliance.features.doors.process import SAMPLE_SECONDS, CountedClient, describe_clients
from appliance.features.doors.session import DoorSession
from tests.support.idle import idle
from tests.support.virtual_clock import VirtualClock


def test_operators_see_the_last_minute_of_the_oldest_connections() -> None:
    session = idle(DoorSession, _socket=ServerProtocol(), received=0, sent=0, refusals=0)
    machine = VirtualClock()
    clients = []
    with clock.using(machine):
        for number in range(MAX_SHOWN + 10):
            machine.advance(1.0)
            clients.append(CountedClient(session, f"10.0.0.{number}", "", []))
    session.received, session.refusals = 600, 2
    for _sample in range(60 // SAMPLE_SECONDS):
        session.received += 5
        for client in clients:
            client.sample()
    session.sent += 7
    first = next(describe_clients(reversed(clients)))
    assert (first.peer, first.received, first.sent, first.refusals) == ("10.0.0.0", 55, 7, 0)
    assert len([*describe_clients(clients)]) == MAX_SHOWN
