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

ROWS = (DOOR_CONNECTIONS,)
