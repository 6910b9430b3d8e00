"""Define every finite resource that hosts can exhaust: its size, the share of each host, and the effect of the limit.

docs/shares.md is generated from `SHARES` (`python -m distribution.shares_page`). Each row names the tests that attack
it; `tests/unit/quotas/test_table.py` checks that they exist. Each row has a name here. The code takes the bounds of its
pool from the row (`Pool("connections", RVMASTER_CONNECTIONS.bounds, …)`), so the page cannot differ from the code.
"""

from typing import NamedTuple

from appliance.quotas.pool import Bounds


class Share(NamedTuple):
    """Describe one row of the table.

    `thing` is the resource with its unit: "connections to RVMaster". `bounds` are the defaults. `at_limit` is the
    effect on the host beyond its share, and on others. `alarm` names the audit event and the metric. `shown_by` lists
    the tests that exhaust the resource, as paths below tests/. `setting` is the key in appliance.yaml that changes the
    bounds ("limits.connections"), or "" if there is none.
    """

    thing: str
    bounds: Bounds
    at_limit: str
    alarm: str
    shown_by: tuple[str, ...]
    setting: str = ""


RVMASTER_CONNECTIONS = Share(
    "connections to RVMaster and the nodes' faces",
    Bounds(whole=4096, host=512, strangers=512, kept=1024),
    "503 with the reason; a host within its share gets the place of an idle or unfinished connection of hosts"
    " that have no more rights to it, strangers first",
    "`limit exceeded`",
    ("integration/master/test_shares.py::test_connections_of_two_hundred_addresses",),
    setting="limits.connections",
)
RVMASTER_ARRIVALS = Share(
    "connections to RVMaster and the nodes' faces that are accepted and not opened yet",
    Bounds(whole=2048, host=512, strangers=256, kept=1024),
    "closed at once, without a word; a connection is opened when it is its host's turn; a stranger here is a host "
    "without a registration that no rule or only `*` names",
    "`limit exceeded`, one for many",
    (
        "unit/rpc/test_server.py::test_connections_that_come_faster_than_they_are_opened",
        "unit/control/test_listener_limits.py::test_hosts_that_only_everybody_names_fill_no_place_of_a_named_host",
    ),
)
RVMASTER_BYTES = Share(
    "bytes of requests and answers under way, RVMaster and faces",
    Bounds(whole=512 << 20, host=64 << 20, strangers=1 << 20, kept=192 << 20),
    "503 with the reason; the request that holds most of a host that holds more makes room",
    "`limit exceeded`",
    (
        "integration/master/test_shares.py::test_requests_of_two_hundred_addresses",
        "unit/rpc/test_connection_table.py::test_bytes_are_freed_by_the_host_that_holds_most",
    ),
)
RVMASTER_FAREWELLS = Share(
    "connections that RVMaster tells that they are too many",
    Bounds(whole=256, host=8, strangers=64, kept=64),
    "closed without a word",
    "`limit exceeded`",
    ("unit/rpc/test_connection_table.py::test_connections_turned_away_in_all",),
)
RVMASTER_REQUESTS = Share(
    "requests that RVMaster and faces serve at once",
    Bounds(whole=64, host=16, strangers=8, kept=52),
    "the request waits for its host's turn; hosts that the policy names as one network take turns as one, and"
    " have half of the whole together",
    "none: nothing is refused",
    (
        "integration/master/test_shares.py::test_requests_of_two_hundred_addresses",
        "unit/rpc/test_fair_queue.py::test_requests_of_many_guests_leave_slots_for_the_robot",
    ),
)
RVMASTER_TIME = Share(
    "processor time of control: microseconds in one turn of its loop",
    Bounds(whole=2000, host=2000, strangers=2000, kept=0),
    "work for the host waits (accepting connections, parsing, deciding, recording, answering); next is the host"
    " that has used least, and all unknown hosts together count as one; a long request is divided into pieces",
    "none: nothing is refused",
    (
        "unit/rpc/test_processor_time.py::test_a_turn_of_the_loop_is_bounded",
        "unit/rpc/test_processor_time.py::test_the_robot_waits_for_one_piece_of_a_flood",
        "unit/rpc/test_processor_time.py::test_two_hundred_unknown_hosts_are_one",
        "unit/rpc/test_server.py::test_many_connections_are_accepted_in_one_turn",
    ),
)
PARAMETER_BYTES = Share(
    "bytes of parameters",
    Bounds(whole=64 << 20, host=32 << 20, strangers=8 << 20, kept=24 << 20),
    "the value is refused, with the reason; one that takes no more than the value in its place is never"
    " refused, and stays charged to the host that had set that one",
    "`limit exceeded`",
    (
        "integration/master/test_shares.py::test_parameters_of_two_hundred_addresses",
        "unit/master/test_parameter_charges.py::test_no_sequence_gets_beyond_a_share",
    ),
    setting="limits.parameter_bytes (the parts are as large in proportion)",
)
LARGE_WRITES = Share(
    "large values on their way to ROSMaster",
    Bounds(whole=2, host=1, strangers=1, kept=1),
    "the value waits for its host's turn; small calls go between",
    "none: nothing is refused",
    ("unit/rpc/test_bulk.py::test_large_values_of_a_host_go_one_at_a_time",),
)
PROBES = Share(
    "nodes that are asked at once whether they are there",
    Bounds(whole=64, host=16, strangers=8, kept=24),
    "the node is asked when it is its host's turn",
    "none: nothing is refused",
    ("unit/master/reconcile/test_liveness.py::test_silent_nodes_of_a_host_delay_no_look_at_anothers",),
)
NODE_CALLS_UNDER_WAY = Share(
    "calls that are being made to nodes for ROSMaster",
    Bounds(whole=512, host=128, strangers=64, kept=192),
    "the call waits for the turn of its host",
    "none: nothing is refused",
    ("unit/master/endpoints/test_delivery.py::test_silent_nodes_of_a_host_delay_no_call_to_anothers",),
)
QUEUED_NODE_CALLS = Share(
    "bytes of calls that wait for nodes",
    Bounds(whole=96 << 20, host=64 << 20, strangers=0, kept=0),
    "the host that has most loses the oldest call to the node that has most of it; the node is told how things"
    " are once it answers",
    "the process log; the node is looked at",
    ("unit/master/endpoints/test_delivery.py::test_a_host_loses_only_calls_of_its_own",),
)
RELAY_FRAMES = Share(
    "bytes of unfinished messages in one relay",
    Bounds(512 << 20, 256 << 20, 0, 0),
    "a host gets no more than is left for all others: its publisher or client that sends more is cut and may come back;"
    " up to 4 KiB of a connection are never refused",
    "`limit exceeded`, `connection closed`; `rosrv_relay_memory_bytes`",
    ("unit/relay/test_shares.py::test_unfinished_messages_of_a_guest_stop_nobody_else",),
    setting="relay.memory_bytes (half of it)",
)
RELAY_QUEUES = Share(
    "bytes that wait for subscribers and clients in one relay",
    Bounds(256 << 20, 128 << 20, 0, 0),
    "a host gets no more than is left for all others: messages for its slow subscribers are dropped, and one that"
    " takes nothing of a message for ten seconds is cut",
    "`rosrv_relay_dropped_total`, `rosrv_relay_memory_bytes`",
    ("unit/relay/test_shares.py::test_subscribers_of_a_guest_that_never_read_stop_nobody_else",),
    setting="relay.memory_bytes (a quarter of it)",
)
RELAY_LATCHED = Share(
    "bytes of latched messages in one relay",
    Bounds(256 << 20, 128 << 20, 0, 0),
    "a host gets no more than is left for all others, and who has most makes room for who has less: a message"
    " that is not kept is passed on; a later subscriber gets it from the publisher once there is room again",
    "`limit exceeded`; `rosrv_relay_memory_bytes`",
    (
        "unit/relay/test_shares.py::test_latched_messages_of_a_guest_stop_nobody_else",
        "unit/relay/test_shares.py::test_latched_messages_of_two_hundred_hosts_leave_room_for_the_robots",
    ),
    setting="relay.memory_bytes (a quarter of it)",
)
RELAY_CONNECTIONS = Share(
    "connections to one relay",
    Bounds(whole=16_384, host=8192, strangers=2048, kept=14_336),
    "closed; a stranger here is a host without a grant, and the longest waiting one makes room for a newcomer;"
    " a host with grants gets the place of a connection of the host that has most, while it has fewer",
    "`connection refused`",
    ("integration/master/test_shares.py::test_connections_to_the_relay",),
    setting="relay.connections",
)
RELAY_HEADERS = Share(
    "bytes of unfinished connection headers in one relay, beyond 4 KiB each",
    Bounds(64 << 20, 16 << 20, 16 << 20, 32 << 20),
    "the long header that waits longest makes room, strangers' first; a peer whose header is beyond its share is turned"
    " away",
    "`connection refused`; `rosrv_relay_memory_bytes`",
    (
        "unit/relay/test_shares.py::test_headers_of_strangers_leave_room_for_the_robots",
        "unit/relay/connections/test_pending_connections.py::test_long_headers_make_room_for_short_ones",
    ),
)
RELAY_TURN = Share(
    "microseconds of processor time in one turn of a relay's loop",
    Bounds(1000, 1000, 1000, 0),
    "the host that has used most waits until the others that are ready have been served, and so does one whose last"
    " message took longer than that, before its next; a stranger here is a host"
    " without a grant; hosts with grants that no rule names, or only `*`, count as one; a change of the policy counts"
    " from the next connection; new connections are accepted in a share of their own and charged to their host too; the"
    " relay's links to control and its supervisor come first",
    "none: nothing is refused",
    (
        "unit/relay/test_loop.py::test_a_host_with_little_to_do_waits_for_one_quantum_of_others",
        "unit/relay/test_loop.py::test_a_host_with_thousands_of_descriptors_gets_no_more_than_one_with_one",
        "unit/relay/test_loop.py::test_costly_messages_of_many_hosts_never_come_in_a_row",
        "unit/relay/test_loop.py::test_all_unknown_hosts_together_are_one_payer",
        "unit/relay/test_relay.py::test_a_topic_with_many_subscribers_is_delivered_a_quantum_at_a_time",
        "unit/relay/test_granted.py::test_hosts_that_only_everybody_names_pay_as_one",
    ),
)
LIMITED_TOPIC = Share(
    "messages and bytes of a topic with a limit, in percent of that limit (a host's is for two hosts that want all)",
    Bounds(whole=100, host=50, strangers=50, kept=0),
    "the messages are dropped; hosts have equal parts, and what one does not use goes to those that want more; unknown"
    " hosts have one part together, and so have the hosts of a network that the policy names; nodes of one host share"
    " its limit as a publisher in the same way",
    "`rate limited`; `rosrv_relay_limited_total`",
    (
        "unit/relay/connections/test_rate_limit.py::test_a_host_within_its_part_loses_nothing_because_of_others",
        "unit/relay/connections/test_rate_limit.py::test_names_of_a_host_share_its_limit",
        "unit/relay/test_relay.py::test_a_limit_counts_hosts_and_not_node_names",
    ),
    setting="[Limits] of the policy",
)
RELAY_MESSAGE = Share(
    "microseconds of processor time that monitors take for one message, request or reply",
    Bounds(10_000, 10_000, 0, 0),
    "the message is cut off, which is a fault of the specification (`on_fault` decides whether it is dropped); for a"
    " second after one, messages of that publication, or of all hosts that no rule but `*` names, have a tenth; the"
    " messages behind it wait for their host's next"
    " turn",
    "`monitor fault`",
    (
        "unit/relay/monitors/test_interceptor.py::test_a_message_that_takes_longer_than_the_budget_is_a_fault",
        "unit/relay/monitors/test_interceptor.py::test_hosts_that_the_policy_does_not_name_have_one_pace",
        "unit/relay/monitors/test_interceptor.py::test_messages_that_do_not_fit_into_a_quantum_are_left_for_the_next_turn",
        "rosmop/tests/test_budget.py::test_every_walk_of_a_message_ends_with_its_time",
    ),
    setting="relay.budget (milliseconds)",
)
RECORDER_MEMORY = Share(
    "bytes of messages that the flight recorder remembers (divided among the relays)",
    Bounds(whole=64 << 20, host=32 << 20, strangers=0, kept=0),
    "while there is room everybody may have it; then what is older than recorder.before goes first, and a topic or a"
    " host beyond its part loses its own oldest messages",
    "the recording says what is missing",
    (
        "unit/recorder/test_ring.py::test_flood_pushes_out_itself",
        "unit/recorder/test_ring.py::test_many_topics_of_a_host_push_out_its_own",
    ),
    setting="recorder.memory (a host's part is half of it, a topic's a quarter)",
)
RECORDER_DISK = Share(
    "bytes of recordings (a stranger here is a host that no rule names, or what no host did; kept is the robot's and"
    " operators')",
    Bounds(whole=2 << 30, host=512 << 20, strangers=512 << 20, kept=512 << 20),
    "the host that would have more makes room from its own, the oldest of the kind of trigger that has most; no host"
    " displaces a recording of the robot, which gets half of the whole back from others; a host begins six recordings"
    " an hour by each kind of trigger, and two hosts but the robot are recorded at once",
    "`recording removed`, `recording missed`; `detail.not_recorded` of the record",
    (
        "unit/recorder/test_recording_store.py::test_a_guest_makes_room_from_its_own",
        "unit/recorder/test_recording_store.py::test_no_guest_displaces_a_recording_of_the_robot",
        "unit/recorder/test_recording_plan.py::test_a_guests_flood_leaves_the_robot_its_recording",
        "unit/recorder/test_recording_plan.py::test_unknown_hosts_are_one",
        "unit/recorder/test_recorder.py::test_a_flood_of_triggers_fills_no_disk",
    ),
    setting="recorder.disk (one recording has an eighth of it)",
)
DRY_RUNS = Share(
    "seconds of processor time of the compiler for the dry run that is under way (a host here is a token)",
    Bounds(whole=10, host=10, strangers=0, kept=0),
    "the dry run is refused, with the seconds; a second one of the same token is refused, those of others wait; an"
    " order that needs the compiler (load, reload, …) ends the dry run, which is answered so",
    "`rest call` with status 422 or 503",
    (
        "unit/compiler/test_process.py::test_nested_repetitions_end_with_the_budget_of_a_dry_run",
        "unit/specifications/test_compiler_link.py::test_an_order_ends_a_dry_run",
        "unit/specifications/test_specifications.py::test_a_client_has_one_dry_run_at_a_time",
    ),
)
SLICES = Share(
    "slices of a parametric specification (of bindings that have ended as many are remembered)",
    Bounds(whole=100_000, host=50_000, strangers=0, kept=0),
    "a host gets no more than is left for all others, and hosts without a registration are one: where the"
    " specification only observes, the oldest slice of the same host is forgotten; where it drops, changes or"
    " publishes messages, the message with a new binding is a fault; no slice is removed for another host's. There are"
    " 1,000 in all where an event or a timer does not bind all parameters, or where a property has no tables",
    "`monitor fault`, a line of the monitor; `rosrv_monitor_slices`",
    (
        "rosmop/tests/test_slices_shares.py::test_a_guest_that_makes_up_ids_refuses_the_robot_nothing",
        "rosmop/tests/test_slices_shares.py::test_a_guest_that_makes_up_ids_pushes_out_its_own",
        "rosmop/tests/test_slices_shares.py::test_one_message_concerns_a_bounded_number_of_slices",
    ),
    setting="slices (the first number)",
)
REST_CONNECTIONS = Share(
    "connections to REST, TLS handshakes included",
    Bounds(whole=512, host=64, strangers=192, kept=320),
    "closed at once; a stranger here is a peer that showed no good token in the last 15 minutes, and the one that waits"
    " longest makes room; next to be opened is the peer that has used least processor time, strangers together as one",
    "none",
    (
        "integration/master/test_shares.py::test_handshakes_with_rest",
        "unit/api/test_listener.py::test_a_known_peer_is_opened_before_strangers_that_came_first",
        "unit/api/test_listener.py::test_strangers_in_the_handshake_make_room",
    ),
    setting="api_limits.connections",
)
_STREAMS_SHOWN_BY = (
    "unit/api/test_streams.py::test_two_hundred_viewers_leave_places_to_operators",
    "integration/api/test_audit.py::test_followers_have_a_share_each",
)
REST_STREAMS = Share(
    "streams of REST, for each of: the audit log followed, /v1/live (a host here is a token, one without a registration"
    " is a viewer's)",
    Bounds(whole=16, host=6, strangers=0, kept=4),
    "503 with the reason and Retry-After",
    "`rest call` with status 503",
    _STREAMS_SHOWN_BY,
    setting="api_limits.streams (the parts are as large in proportion)",
)
REST_STREAM_PEERS = Share(
    "streams of REST, by the machine that follows",
    Bounds(whole=16, host=8, strangers=0, kept=0),
    "503 with the reason and Retry-After",
    "`rest call` with status 503",
    _STREAMS_SHOWN_BY,
    setting="api_limits.streams (the parts are as large in proportion)",
)
REST_EXPORTS = Share(
    "exports of the log and of evidence under way (a host here is a token, one without a registration is a viewer's)",
    Bounds(whole=4, host=2, strangers=0, kept=1),
    "503 with the reason and Retry-After",
    "`rest call` with status 503",
    _STREAMS_SHOWN_BY,
)
AUDIT_KINDS = Share(
    "kinds of folded denials in the audit log",
    Bounds(whole=8192, host=256, strangers=64, kept=0),
    "further denials are counted as one kind of that host; those of strangers as one kind of all strangers",
    "`denials folded` with `scope` host or strangers",
    (
        "unit/audit/test_folding.py::test_strangers_with_reasons_of_their_own_take_no_kind_of_a_named_host",
        "unit/audit/test_folding.py::test_many_named_hosts_keep_a_line_each",
        "integration/master/test_audit_shares.py::test_strangers_push_no_denial_of_a_named_host_out",
    ),
)
AUDIT_READ_KINDS = Share(
    "kinds of folded reads in the audit log",
    Bounds(whole=8192, host=512, strangers=0, kept=0),
    "further reads are recorded in full and count as bytes of the host",
    "none",
    ("unit/audit/test_folding.py::test_reads_beyond_the_share_are_recorded_in_full",),
)
AUDIT_BYTES = Share(
    "bytes of audit records to pay off; time pays 64 KiB a second of each host's",
    Bounds(whole=1 << 40, host=16 << 20, strangers=0, kept=1 << 39),
    "the host's calls wait, one of many parts is refused in words; strangers are served nothing, and what is"
    " recorded of that is folded",
    "`limit exceeded`",
    (
        "unit/audit/test_budget.py::test_two_hundred_hosts_leave_the_robot_its_share",
        "unit/audit/test_budget.py::test_who_owes_too_much_waits_until_it_is_paid",
        "integration/master/test_audit_shares.py::test_reads_with_long_keys_fill_no_disk",
    ),
)
AUDIT_RESERVE = Share(
    "bytes of the disk that are kept for the audit log",
    Bounds(whole=64 << 20, host=1 << 20, strangers=0, kept=16 << 20),
    "below it a host pays off 8 KiB a second, and its calls wait for that; of the last quarter only hosts with"
    " a registration have any, the others are refused in words; on a full disk nothing is granted until there is room",
    "`disk nearly full`; `rosrv status`",
    (
        "unit/audit/test_budget.py::test_the_last_of_the_disk_is_for_hosts_with_a_registration",
        "unit/audit/test_disk_space.py::test_a_disk_that_fills_is_told_before_it_is_full",
    ),
    setting="audit.reserve_bytes",
)
NODE_PORTS = Share(
    "ports of [Ports] (one for each node and relay, and one more for each node)",
    Bounds(whole=7000, host=5250, strangers=0, kept=0),
    "a host may have three times as many as are left for all others, and hosts that the policy names as one network are"
    " one; nodes without a registration make room at once; then registering is refused",
    "the refused call's record",
    (
        "integration/master/test_shares.py::test_ports_and_names",
        "unit/master/endpoints/test_endpoint_addresses.py::test_no_host_takes_all_ports",
    ),
    setting="[Ports] range of the policy",
)
NAMES = Share(
    "registrations (topics, services and parameters of nodes)",
    Bounds(whole=50_000, host=5000, strangers=0, kept=0),
    "a host may have three times as many as are left, and hosts that the policy names as one network are one; then"
    " registering is refused with the reason",
    "`decision`: the refused call's record",
    (
        "integration/master/test_floods.py::test_registrations_of_one_node",
        "unit/master/calls/test_gate.py::test_a_host_has_as_many_registrations_as_are_left",
    ),
    setting="limits.topics_per_host (a host's)",
)
GRANTS = Share(
    "grants of the relays (permissions to subscribe to a topic or to call a service)",
    Bounds(whole=200_000, host=20_000, strangers=0, kept=0),
    "the host, or of all hosts that with most, loses its oldest grants that nobody is connected by",
    "none: a node that asks again gets it again",
    ("unit/master/endpoints/test_relay_control.py::test_grants_of_all_hosts_are_bounded",),
)
IKE_HANDSHAKES = Share(
    "IKE handshakes under way (a host is an address; nobody is known before his handshake)",
    Bounds(whole=2000, host=5, strangers=2000, kept=0),
    "not answered until one ends, after 15 s at most; from 30 on an address has to answer once before it counts",
    "none: charon's log",
    ("unit/ipsec/test_strongswan.py::test_two_hundred_addresses_leave_handshakes_for_hosts",),
)
DESCRIPTORS = Share(
    "descriptors of control, of each relay, of the supervisor (the api has a sixteenth of it)",
    Bounds(whole=65_536, host=32_768, strangers=32_768, kept=32_768),
    "never reached: where the system allows fewer, connections have no more than half of them, and those above it are"
    " told so as above any other share",
    "none",
    ("unit/quotas/test_descriptors.py::test_all_shares_together_fit_the_descriptors",),
    setting="the system's limit (nofile)",
)

SHARES: tuple[Share, ...] = tuple(row for row in list(globals().values()) if isinstance(row, Share))
"""Every row above, in the order of the page."""
