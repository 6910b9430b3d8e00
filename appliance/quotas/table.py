"""Define every finite resource that hosts can exhaust: its size, the quota of each host, and the effect of the limit.

The code and docs/reference/generated/quotas.md take the bounds from the same rows.
"""

from typing import Literal, NamedTuple

from appliance.quotas.pool import Bounds


class HonestUse(NamedTuple):
    """The honest use that comes closest to a quota.

    `needs` is its amount in the unit of the row; 0 if no honest host comes near, or if only turns are divided.
    `of` is the bound that it meets first: of one host, of all hosts (`whole`), of all without the part that is kept
    free (`unkept`), or of the robot's part of the disk. `beyond` describes what a host or person notices beyond it.
    """

    use: str
    needs: int
    of: Literal["host", "whole", "unkept", "robot"] = "host"
    beyond: str = ""


class QuotaRow(NamedTuple):
    """One resource and its quotas.

    `thing` is the resource with its unit: "connections to RVMaster". `alarm` names the audit event and the metric.
    `margin` compares the bounds with an honest use. `setting` is the key in appliance.yaml that changes the bounds, or
    "". `between` describes the order of hosts and which host makes room. `counting` defines a host, an unknown host and
    the kept part, where they differ from the general rule of the page.
    """

    thing: str
    bounds: Bounds
    at_limit: str
    alarm: str
    margin: HonestUse
    setting: str = ""
    between: str = ""
    counting: str = ""


RVMASTER_CONNECTIONS = QuotaRow(
    thing="connections to RVMaster and the proxy endpoints",
    bounds=Bounds(whole=4096, host=512, unknown=512, kept=1024),
    at_limit="503 with the reason",
    between="a host within its quota replaces an idle or unfinished connection of a host of the same or a lower"
    " class, unknown hosts first; a host beyond it replaces its own idle connections",
    counting="unknown: no registration, and no rule or only `*` names the host; registered: the policy names it too",
    alarm="`limit exceeded`",
    setting="limits.connections",
    margin=HonestUse(
        "200 nodes of one machine, each with a connection to RVMaster and to five other nodes",
        1_200,
        beyond="its idle connections are replaced, the longest idle one first; a client connects again",
    ),
)
RVMASTER_ARRIVALS = QuotaRow(
    thing="connections to RVMaster and the proxy endpoints that are accepted and not opened yet",
    bounds=Bounds(whole=2048, host=512, unknown=256, kept=1024),
    at_limit="closed at once, without an answer",
    between="connections are opened in turns of hosts",
    counting="unknown: no registration, and no rule or only `*` names the host; registered: the policy names it too",
    alarm="`limit exceeded`, one record for many connections",
    margin=HonestUse(
        "200 nodes of one machine that connect in the same instant, to RVMaster and one other node",
        400,
    ),
)
RVMASTER_BYTES = QuotaRow(
    thing="bytes of requests and answers under way at RVMaster and the proxy endpoints",
    bounds=Bounds(whole=512 << 20, host=64 << 20, unknown=1 << 20, kept=192 << 20),
    at_limit="503 with the reason",
    between="the largest request of a host that holds more makes room",
    alarm="`limit exceeded`",
    margin=HonestUse(
        "a launch file that sets 5,000 parameters of 400 bytes in one request",
        2_000_000,
    ),
)
RVMASTER_FAREWELLS = QuotaRow(
    thing="connections that RVMaster is rejecting with a 503",
    bounds=Bounds(whole=256, host=8, unknown=64, kept=64),
    at_limit="closed without an answer",
    alarm="`limit exceeded`",
    margin=HonestUse(
        "",
        0,
    ),
)
RVMASTER_REQUESTS = QuotaRow(
    thing="requests that RVMaster and the proxy endpoints serve at once",
    bounds=Bounds(whole=64, host=16, unknown=8, kept=32),
    at_limit="the request waits for its host's turn",
    between="each host that a rule names has one more of its own, so it never waits for another host's requests; hosts"
    " that the policy names as one network, or only by `*`, share turns and get at most half of the whole",
    alarm="none",
    margin=HonestUse(
        "200 nodes of one machine that call at once",
        200,
        beyond="each waits for the calls before it; one thread carries them out in any case",
    ),
)
RVMASTER_TIME = QuotaRow(
    thing="microseconds of processor time in one turn of control's loop",
    bounds=Bounds(whole=2000, host=2000, unknown=2000, kept=0),
    at_limit="the host's work waits: accepting connections, parsing, deciding, recording, answering; a long request"
    " is divided",
    between="next is the host that has used least",
    counting="all unknown hosts count as one host",
    alarm="none",
    margin=HonestUse(
        "200 nodes that start beside a browser",
        0,
        beyond="other hosts go first if the robot has used more time than they have",
    ),
)
PARAMETER_BYTES = QuotaRow(
    thing="bytes of parameters",
    bounds=Bounds(whole=64 << 20, host=32 << 20, unknown=8 << 20, kept=24 << 20),
    at_limit="the value is rejected with the reason; a value that is not larger than the value that it replaces is"
    " always accepted",
    counting="a replacement that is not larger stays charged to the host of the replaced value",
    alarm="`limit exceeded`",
    setting="limits.parameter_bytes (the quotas scale with it)",
    margin=HonestUse(
        "5,000 parameters of 200 bytes, and a robot description of 500 KB",
        1_500_000,
    ),
)
LARGE_WRITES = QuotaRow(
    thing="large values under way to the ROS master and to a standby",
    bounds=Bounds(whole=3, host=1, unknown=1, kept=1),
    at_limit="the value waits for its host's turn; small calls need not wait for it",
    alarm="none",
    margin=HonestUse(
        "one large value at a time, such as a robot description",
        1,
        beyond="a second one waits for the first",
    ),
)
PROBES = QuotaRow(
    thing="liveness checks of nodes under way",
    bounds=Bounds(whole=64, host=16, unknown=8, kept=24),
    at_limit="the check waits for its host's turn",
    alarm="none",
    margin=HonestUse(
        "200 nodes of one machine that are killed at once",
        200,
        beyond="checks go in turns; a closed port answers at once",
    ),
)
NODE_CALLS_UNDER_WAY = QuotaRow(
    thing="calls to nodes under way",
    bounds=Bounds(whole=512, host=128, unknown=64, kept=192),
    at_limit="the call waits for its host's turn",
    alarm="none",
    margin=HonestUse(
        "200 nodes of one machine that learn of a new publisher",
        200,
        beyond="the calls go in turns",
    ),
)
QUEUED_NODE_CALLS = QuotaRow(
    thing="bytes of calls that wait for nodes",
    bounds=Bounds(whole=96 << 20, host=64 << 20, unknown=0, kept=0),
    at_limit="the oldest call in the longest queue is dropped; the node gets the present state when it answers again",
    between="the host with most bytes loses the call",
    alarm="the process log",
    margin=HonestUse(
        "ten waiting lists of 1 KB for each of 200 nodes",
        2_000_000,
    ),
)
RELAY_FRAMES = QuotaRow(
    thing="bytes of unfinished messages in one relay",
    bounds=Bounds(whole=512 << 20, host=256 << 20, unknown=0, kept=0, share=1),
    at_limit="the connection of the publisher or client is closed; it may connect again; up to 4 KiB of a connection"
    " are always accepted",
    between="a host gets at most as much as is left for all others",
    alarm="`limit exceeded`, `connection closed`; `rosrv_relay_memory_bytes`",
    setting="relay.memory_bytes (half of it)",
    margin=HonestUse(
        "ten cameras with images of 6 MB and four lidars with clouds of 2 MB, all under way",
        68_000_000,
    ),
)
RELAY_QUEUES = QuotaRow(
    thing="bytes that wait for subscribers and clients in one relay",
    bounds=Bounds(whole=256 << 20, host=128 << 20, unknown=0, kept=0, share=1),
    at_limit="messages for the host's slow subscribers are dropped, and service calls that cannot be passed on at"
    " once are cut; a subscriber that reads nothing for ten seconds is disconnected",
    between="a host gets at most as much as is left for all others",
    alarm="`rosrv_relay_dropped_total`, `rosrv_relay_memory_bytes`",
    setting="relay.memory_bytes (a quarter of it)",
    margin=HonestUse(
        "ten subscribers that are one image of 6 MB behind",
        60_000_000,
    ),
)
RELAY_LATCHED = QuotaRow(
    thing="bytes of latched messages in one relay",
    bounds=Bounds(whole=256 << 20, host=128 << 20, unknown=0, kept=0, share=1),
    at_limit="the message is relayed and not kept; a later subscriber gets it from the publisher when there is room"
    " again",
    between="a host gets at most as much as is left for all others; the host with most makes room for hosts with"
    " less",
    alarm="`limit exceeded`; `rosrv_relay_memory_bytes`",
    setting="relay.memory_bytes (a quarter of it)",
    margin=HonestUse(
        "three maps of 16 MB and a thousand small latched messages",
        50_000_000,
    ),
)
RELAY_CONNECTIONS = QuotaRow(
    thing="connections to one relay",
    bounds=Bounds(whole=16_384, host=8192, unknown=2048, kept=14_336),
    at_limit="closed",
    between="a host with grants replaces a connection of the host that has most; a new unknown host replaces the"
    " unknown connection that has waited longest",
    counting="unknown: no grant",
    alarm="`connection refused`",
    setting="relay.connections",
    margin=HonestUse(
        "200 nodes of one machine with one relay: ten publications and ten subscriptions each",
        4_000,
    ),
)
RELAY_HEADERS = QuotaRow(
    thing="bytes of unfinished connection headers in one relay, beyond 4 KiB each",
    bounds=Bounds(whole=64 << 20, host=16 << 20, unknown=16 << 20, kept=32 << 20, share=1),
    at_limit="the connection is closed",
    between="the long header that has waited longest makes room, those of unknown hosts first",
    alarm="`connection refused`; `rosrv_relay_memory_bytes`",
    margin=HonestUse(
        "200 connections at once whose headers have a message definition of 8 KB",
        1_000_000,
    ),
)
RELAY_TURN = QuotaRow(
    thing="microseconds of processor time in one turn of a relay's loop",
    bounds=Bounds(whole=1000, host=1000, unknown=1000, kept=0),
    at_limit="the host's messages and new connections wait until the other ready hosts have been served",
    between="next is the host that has used least; the relay's links to control and supervisor come first",
    counting="unknown: no grant; hosts with grants that no rule or only `*` names count as one; a policy change"
    " applies to new connections",
    alarm="none",
    margin=HonestUse(
        "a host with ten cameras beside one that sends a stop",
        0,
        beyond="the camera host waits for the other one",
    ),
)
LIMITED_TOPIC = QuotaRow(
    thing="messages and bytes of a topic with a limit, in percent of the limit (one host: when two hosts want all)",
    bounds=Bounds(whole=100, host=50, unknown=50, kept=0),
    at_limit="the messages are dropped",
    between="hosts have equal parts; an unused part goes to the others; nodes of one host share its limit as a"
    " publisher in the same way",
    counting="all unknown hosts count as one host, and so do the hosts of a network that the policy names",
    alarm="`rate limited`; `rosrv_relay_limited_total`",
    setting="[Limits]",
    margin=HonestUse(
        "a topic at the rate for which the operator set the limit",
        0,
        beyond="the operator sets the limit",
    ),
)
RELAY_MESSAGE = QuotaRow(
    thing="microseconds of processor time that monitors take for one message, request or reply",
    bounds=Bounds(whole=10_000, host=10_000, unknown=0, kept=0),
    at_limit="the monitor is stopped with a fault (`on_fault` decides whether the message is dropped; it passes if it"
    " is only observed); for 4 s, up to 16 s if it happens again, messages of that publication of at least half the"
    " size have a tenth of the time",
    between="other messages of the host wait for its next turn",
    counting="all hosts that no rule or only `*` names count as one publication",
    alarm="`monitor fault`",
    setting="relay.budget (milliseconds)",
    margin=HonestUse(
        "a monitor that publishes a changed laser scan of twice 100 numbers",
        100,
    ),
)
DRY_RUNS = QuotaRow(
    thing="seconds of processor time of the compiler for one dry run",
    bounds=Bounds(whole=10, host=10, unknown=0, kept=0),
    at_limit="the dry run is rejected with the seconds used; a second one of the same token is rejected",
    between="dry runs of other tokens wait; an order that needs the compiler (load, reload, …) ends the dry run with"
    " an error",
    counting="a host is a token",
    alarm="`rest call` with status 422 or 503",
    margin=HonestUse(
        "a specification that compiles in a second",
        1,
    ),
)
SLICES = QuotaRow(
    thing="slices of a parametric specification (the engine also remembers as many ended bindings)",
    bounds=Bounds(whole=100_000, host=50_000, unknown=0, kept=0),
    at_limit="observing specifications free the host's oldest slice; in others, the message with a new binding is a"
    " fault; 250 slices where an event or timer does not bind all parameters, 1,000 where a property has no"
    " tables",
    between="a host gets at most as many as are left for all others, and never displaces a slice of another host",
    counting="hosts without a registration count as one",
    alarm="`monitor fault`, a log line of the monitor; `rosrv_monitor_slices`",
    setting="slices (a declaration in the specification; its first number)",
    margin=HonestUse(
        "a monitor with a slice for each of 1,000 tracked objects",
        1_000,
    ),
)
REST_CONNECTIONS = QuotaRow(
    thing="connections to REST, including TLS handshakes",
    bounds=Bounds(whole=512, host=320, unknown=192, kept=320),
    at_limit="closed at once",
    between="the unknown connection that has waited longest makes room; the peer that has used least processor time"
    " is opened next, unknown hosts together as one",
    counting="a host is a peer's address; unknown: no valid token in the last 15 minutes",
    alarm="none",
    setting="api_limits.connections",
    margin=HonestUse(
        "50 browsers behind one address, with six connections each",
        300,
    ),
)
_STREAMS_SHOWN_BY = (
    "unit/api/front/test_streams.py::test_two_hundred_viewers_leave_slots_to_operators",
    "unit/api/front/test_streams.py::test_one_token_has_a_quota_and_one_machine_none",
)
REST_STREAMS = QuotaRow(
    thing="streams of REST by token: followers of the audit log, and of `/v1/live` (a limit for each)",
    bounds=Bounds(whole=64, host=24, unknown=0, kept=16),
    at_limit="503 with the reason and Retry-After",
    counting="a host is a token or a session; kept: not for viewers",
    alarm="`rest call` with status 503",
    setting="api_limits.streams (the quotas scale with it)",
    margin=HonestUse(
        "24 viewers behind one address, each on a page that follows the robot",
        24,
        of="unkept",
        beyond='a page shows "too many clients follow" and tries again; raise `api_limits.streams` for more',
    ),
)
REST_EXPORTS = QuotaRow(
    thing="exports of the audit log and of evidence under way",
    bounds=Bounds(whole=4, host=2, unknown=0, kept=1),
    at_limit="503 with the reason and Retry-After",
    counting="a host is a token; kept: not for viewers",
    alarm="`rest call` with status 503",
    margin=HonestUse(
        "one export at a time for each person",
        1,
        beyond="a further one is answered 503 until one of them ends",
    ),
)
REST_WORK = QuotaRow(
    thing="slow answers of REST of one kind under way: dry runs and explanations (4: searches of the audit log; 1: its"
    " summary, its verification, a recording)",
    bounds=Bounds(whole=2, host=1, unknown=0, kept=1),
    at_limit="the request waits for its token's turn, and gets 503 with Retry-After after 5 s",
    between="next is the token with the longest wait since its last turn",
    counting="a host is a token; kept: not for viewers",
    alarm="`rest call` with status 503",
    margin=HonestUse(
        "one search at a time for each person",
        1,
        beyond="a further one waits",
    ),
)
TOPIC_LOOKS = QuotaRow(
    thing="queries of topics' messages under way",
    bounds=Bounds(whole=8, host=6, unknown=0, kept=0, share=3),
    at_limit="503 with the reason",
    between="a host gets one, and further ones up to three times what it leaves for all others",
    counting="a host is a token, or all users of `rosrv` on the appliance's machine",
    alarm="`rest call` with status 503",
    margin=HonestUse(
        "a test of a guard that watches the commands and four topics of odometry",
        5,
    ),
)
AUDIT_KINDS = QuotaRow(
    thing="kinds of folded denials in the audit log",
    bounds=Bounds(whole=8192, host=256, unknown=64, kept=0),
    at_limit="further denials of the host are counted as one kind",
    between="further denials of all unknown hosts are counted as one kind",
    alarm="`denials folded` with `scope` `host` or `unknown hosts`",
    margin=HonestUse(
        "a robot whose 20 nodes are each denied ten things, again and again",
        200,
    ),
)
AUDIT_READ_KINDS = QuotaRow(
    thing="kinds of folded reads in the audit log",
    bounds=Bounds(whole=8192, host=2048, unknown=0, kept=0),
    at_limit="further reads are recorded in full and charged to the host's bytes of audit records",
    alarm="none",
    margin=HonestUse(
        "200 nodes of one machine that each read their own parameters, `/use_sim_time` and two others",
        800,
    ),
)
AUDIT_RATE = 64 << 10
"""Bytes a second by which a host's debt of audit records falls."""
AUDIT_ROBOT_PART, AUDIT_NAMED_PART, MAX_AUDIT_NAMED = 4, 64, 256 << 20
"""The robot's part of the disk's free space is one of 4, that of an address or network of the policy one of 64, at most
256 MiB.
"""
AUDIT_BYTES = QuotaRow(
    thing="bytes of audit records that a host owes; its debt falls by 64 KiB a second",
    bounds=Bounds(whole=1 << 40, host=16 << 20, unknown=16 << 20, kept=1 << 39),
    at_limit="the host's calls wait once its group has also used up its part of the free disk space; a multicall's"
    " excess parts are rejected with the reason",
    between="the robot may owe a quarter of the free disk space; an address or network that the policy names a 64th,"
    " at most 256 MiB (with `audit.retention_bytes`, a 64th of that if it is less); while a quarter of the log's queue"
    " waits for the disk (for the robot three quarters), no host has a part. Records of unknown hosts whose calls are"
    " denied are folded; in audit-only mode, where their calls pass, all unknown hosts owe as one",
    alarm="`limit exceeded`",
    margin=HonestUse(
        "20 starts in a row of 200 nodes with 5,000 parameters, 5 MB of records each, at 512 MB of free disk space",
        100_000_000,
        of="robot",
    ),
)
AUDIT_RESERVE = QuotaRow(
    thing="bytes of free disk space reserved for the audit log",
    bounds=Bounds(whole=64 << 20, host=1 << 20, unknown=0, kept=16 << 20),
    at_limit="a host's debt falls by 8 KiB a second and its calls wait (the robot's once it owes a quarter of what is"
    " left); on a full disk every call is denied until there is room",
    between="the last quarter is for the robot and the hosts that the policy names by address or group (for hosts with"
    " a registration if it names none); calls of others are rejected with the reason",
    alarm="`disk nearly full`; `rosrv status`",
    setting="audit.reserve_bytes",
    margin=HonestUse(
        "a start of 100 nodes with 60 MB left, 2.2 MB of records",
        2_200_000,
        of="robot",
    ),
)
NODE_PORTS = QuotaRow(
    thing="ports of `[Ports]`: one for each node, and one for each node and relay",
    bounds=Bounds(whole=7000, host=5250, unknown=0, kept=0),
    at_limit="the registration is rejected with the reason",
    between="a host gets at most three times what is left for all others; nodes without a registration, and"
    " those lost for ten minutes, make room at once",
    counting="hosts that the policy names as one network count as one",
    alarm="`decision`: the record of the rejected call",
    setting="[Ports] range",
    margin=HonestUse(
        "200 nodes of one machine with four relays",
        1_000,
    ),
)
NODES = QuotaRow(
    thing="nodes: each has one of the ports of `[Ports]`",
    bounds=Bounds(whole=NODE_PORTS.bounds.whole, host=500, unknown=0, kept=0),
    at_limit="the registration of one more node is rejected with the reason",
    between="a node of the host that has ended, was replaced, or was lost longest makes room",
    alarm="`decision`: the record of the rejected call",
    setting="limits.nodes_per_host (for a host)",
    margin=HonestUse(
        "200 nodes of one machine",
        200,
    ),
)
NAMES = QuotaRow(
    thing="registrations (topics, services and parameters of nodes)",
    bounds=Bounds(whole=50_000, host=12_500, unknown=0, kept=0),
    at_limit="the registration is rejected with the reason",
    between="a host gets at most three times what is left",
    counting="hosts that the policy names as one network count as one",
    alarm="`decision`: the record of the rejected call",
    setting="limits.topics_per_host (for a host)",
    margin=HonestUse(
        "200 nodes of one machine: ten publications, ten subscriptions, two services each",
        4_400,
    ),
)
GRANTS = QuotaRow(
    thing="grants of the relays (permissions to subscribe to a topic or to call a service)",
    bounds=Bounds(whole=200_000, host=20_000, unknown=0, kept=0),
    at_limit="the host's oldest unused grants are removed; a node that asks again gets them again",
    between="at the limit of the whole, the host with most grants loses them",
    alarm="none",
    margin=HonestUse(
        "200 nodes of one machine with ten subscriptions and ten service clients each",
        4_000,
    ),
)
IKE_HANDSHAKES = QuotaRow(
    thing="IKE handshakes under way",
    bounds=Bounds(whole=2000, host=5, unknown=2000, kept=0),
    at_limit="no answer until another handshake ends, after 15 s at most",
    between="from 30 handshakes on, an address counts only after it has answered once",
    counting="a host is an address; every host is unknown before its handshake",
    alarm="charon's log",
    margin=HonestUse(
        "one machine that connects, and again after a lost packet",
        2,
    ),
)
DESCRIPTORS = QuotaRow(
    thing="file descriptors of control, of each relay and of the supervisor (the api has a sixteenth)",
    bounds=Bounds(whole=65_536, host=32_768, unknown=32_768, kept=32_768),
    at_limit="connections beyond half of the system's limit are rejected like those beyond any other quota",
    alarm="none",
    setting="nofile (the limit of the system)",
    margin=HonestUse(
        "4,096 connections to RVMaster, and those of 200 nodes with four relays",
        10_000,
    ),
)

QUOTA_ROWS = (
    RVMASTER_CONNECTIONS, RVMASTER_ARRIVALS, RVMASTER_BYTES, RVMASTER_FAREWELLS, RVMASTER_REQUESTS, RVMASTER_TIME,
    PARAMETER_BYTES, LARGE_WRITES, PROBES, NODE_CALLS_UNDER_WAY, QUEUED_NODE_CALLS, RELAY_FRAMES,
    RELAY_QUEUES, RELAY_LATCHED, RELAY_CONNECTIONS, RELAY_HEADERS, RELAY_TURN, LIMITED_TOPIC, RELAY_MESSAGE,
    DRY_RUNS, SLICES, REST_CONNECTIONS, REST_STREAMS,
    REST_EXPORTS, REST_WORK, TOPIC_LOOKS, AUDIT_KINDS, AUDIT_READ_KINDS, AUDIT_BYTES, AUDIT_RESERVE, NODE_PORTS,
    NODES, NAMES, GRANTS, IKE_HANDSHAKES, DESCRIPTORS,
)  # fmt: skip
"""Every row of the core, in the order of the page. A test checks that none is missing. Features add rows."""
