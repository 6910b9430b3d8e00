"""The quotas of doors."""

from appliance.quotas.pool import Bounds
from appliance.quotas.table import HonestUse, QuotaRow

HOST_SHARE = 3
"""A host gets at most this many times what it leaves for all others."""

DOOR_CONNECTIONS = QuotaRow(
    thing="connections of a door",
    bounds=Bounds(whole=1024, host=32, unknown=0, kept=0),
    at_limit="503 with the reason",
    between="each door has a process and connections of its own: a flood at one door takes nothing of another. A host"
    " gets one connection of a door, and further ones up to three times what is left for all others (24 of 32); the"
    " same holds for new connections",
    counting="host: a door",
    alarm="`rosrv door list`, `rosrv limits`",
    setting="doors.connections",
    margin=HonestUse(
        "20 browsers of one door",
        20,
        beyond="raise `doors.connections` for more",
    ),
)

DOOR_BYTES = QuotaRow(
    thing="bytes that clients of one door hold: names and ids, frames until they are carried out, replies and"
    " messages until they are sent to a client or another node",
    bounds=Bounds(whole=256 << 20, host=56 << 20, unknown=0, kept=0),
    at_limit="the oldest messages are dropped; a client with too large a frame, or that does not read its replies, is"
    " disconnected with the reason; values that take too much are refused in words",
    between="each client has 1/68 for itself (half of the whole, divided by `doors.connections` and two); beyond that,"
    " a client gets at most as much as it leaves for all others, and is disconnected if it takes less than 512 KB in"
    " five seconds, or sends less than 256 KB in ten seconds of a frame that it has begun. All"
    " clients of one host get at most three times what is left for those of other hosts. Two more count"
    " as clients: messages to other nodes, and arguments of calls that wait for answers",
    counting="host: a client's connection",
    alarm="`rosrv_door_messages_dropped_total`",
    margin=HonestUse(
        "20 clients that are one image of 1 MB behind",
        20_000_000,
        of="whole",
    ),
)

DOOR_TOPICS = QuotaRow(
    thing="topics that clients of one door publish, and topics to which they subscribe",
    bounds=Bounds(whole=500, host=375, unknown=0, kept=0, share=HOST_SHARE),
    at_limit="refused in words",
    between="a host gets at most three times what is left for all others; a topic without a client ends early",
    counting="host: the address of a client",
    alarm="`rosrv_door_refusals_total`",
    margin=HonestUse(
        "20 clients with ten topics each",
        200,
    ),
)

DOOR_CALLS = QuotaRow(
    thing="calls of services by clients of one door that wait for answers, also after the client has left",
    bounds=Bounds(whole=256, host=192, unknown=0, kept=0, share=HOST_SHARE),
    at_limit="refused in words",
    between="a client has at most 100; a host gets at most three times what is left for all others",
    counting="host: the address of a client",
    alarm="`rosrv_door_refusals_total`",
    margin=HonestUse(
        "20 clients with two calls that wait",
        40,
    ),
)

DOOR_SERVICES = QuotaRow(
    thing="services that clients of one door offer",
    bounds=Bounds(whole=400, host=300, unknown=0, kept=0, share=HOST_SHARE),
    at_limit="refused in words",
    between="a client offers at most 100; a host gets at most three times what is left for all others",
    counting="host: the address of a client",
    alarm="`rosrv_door_refusals_total`",
    margin=HonestUse(
        "20 clients that offer two services each",
        40,
    ),
)

DOOR_PARAMETERS = QuotaRow(
    thing="parameters to which clients of one door subscribe",
    bounds=Bounds(whole=2000, host=1500, unknown=0, kept=0, share=HOST_SHARE),
    at_limit="refused in words",
    between="a client has at most 1000; a host gets at most three times what is left for all others",
    counting="host: the address of a client",
    alarm="`rosrv_door_refusals_total`",
    margin=HonestUse(
        "20 clients with 20 parameters each",
        400,
    ),
)

ROWS = (DOOR_CONNECTIONS, DOOR_BYTES, DOOR_TOPICS, DOOR_CALLS, DOOR_SERVICES, DOOR_PARAMETERS)
