"""The quotas of doors."""

from appliance.quotas.pool import Bounds
from appliance.quotas.table import QuotaRow

DOOR_CONNECTIONS = QuotaRow(
    thing="connections of a door",
    bounds=Bounds(whole=1024, host=32, unknown=0, kept=0),
    at_limit="503 with the reason",
    between="each door has a process and connections of its own: a flood at one door takes nothing of another",
    counting="host: a door",
    alarm="`rosrv door list`, `rosrv limits`",
    setting="doors.connections",
    shown_by=(
        "unit/features/doors/test_session.py::test_connections_of_a_door_are_bounded_in_number_and_rate",
        "unit/features/doors/test_door_table.py::test_doors_are_bounded",
    ),
)

DOOR_BYTES = QuotaRow(
    thing="bytes that clients of one door hold: frames until they are carried out, replies and messages until they are"
    " sent to a client or another node",
    bounds=Bounds(whole=256 << 20, host=56 << 20, unknown=0, kept=0),
    at_limit="the oldest messages are dropped; a client with too large a frame, or that does not read its replies, is"
    " disconnected with the reason; values that take too much are refused in words",
    between="each client has 1/68 for itself (half of the whole, divided by `doors.connections` and two); beyond that,"
    " a client gets at most as much as it leaves for all others, and is disconnected if it takes less than 512 KB in"
    " five seconds, or sends less than 256 KB in ten seconds of a frame that it has begun. Two more count"
    " as clients: messages to other nodes, and arguments of calls that wait for answers",
    counting="host: a client's connection",
    alarm="`rosrv_door_messages_dropped_total`",
    shown_by=(
        "unit/features/doors/test_door_memory.py::test_greedy_clients_leave_memory_for_the_next_one",
        "unit/features/doors/test_session.py::test_a_client_that_does_not_read_gives_shared_memory_back_within_seconds",
        "unit/features/doors/test_unfinished.py::test_a_client_that_holds_memory_of_others_must_send_the_rest_faster",
    ),
)

ROWS = (DOOR_CONNECTIONS, DOOR_BYTES)
