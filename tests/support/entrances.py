"""The table of entrances: every way into the appliance against every rule.

A cell names the tests that turn red when the rule is taken out of this entrance, or gives the reviewed reason why the
rule does not apply, which begins with `-`. `tests/unit/test_entrances.py` derives the entrances from the code.
"""

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

RULES = {
    "block": "a blocked host is refused, and what it has open ends",
    "end of a right": "what is open ends with the right, token, ticket or certificate that opened it",
    "unknown": "who is unknown is decided in one place, and gets no more than all unknown together",
    "folding": "refusals are recorded as denials of the peer, and repetitions are folded",
    "share": "a host gets a part, and leaves the rest to others",
    "binding": "an address belongs to its sender",
    "failure": "a failure is remembered, so it does not cost each time",
}

_FIREWALL = "unit/network/firewall/test_firewall_rules.py::"
_MASTER = "unit/control/assembly/test_listener_limits.py::"
_RELAY = "unit/relay/test_data_plane.py::"
_DOORS = "unit/features/doors/"
_REST = "unit/api/front/"
_FOLD = "unit/audit/log/test_folding.py::"
_BLOCKS = "unit/features/blocks/test_block_orders.py::"
_GRANTS = "unit/relay/test_grant_table.py::"
_SSO = "unit/features/sso/"
_TUNNELS = "unit/features/tunnels/test_enrolment.py::"
_COLLECTOR = (
    "- the collector is another machine with its own accounts; `rosrv host block` is of one appliance"
)

CELLS: dict[str, dict[str, str]] = {
    "RVMaster": {
        "block": f"{_MASTER}test_a_blocked_host_is_refused_before_its_request_is_read"
        " unit/policy/test_policy.py::test_a_block_denies_every_request_of_its_host_alone",
        "end of a right": f"{_BLOCKS}test_a_block_ends_everything_and_what_is_lifted_returns",
        "unknown": "unit/control/assembly/test_quota_class.py::test_a_blocked_host_is_unknown"
        " unit/rpc/test_processor_time.py::test_two_hundred_unknown_hosts_are_one",
        "folding": f"{_FOLD}test_varied_addresses_are_folded_together {_FOLD}test_reads_are_folded_like_denials",
        "share": "unit/rpc/test_fair_queue.py::test_requests_of_many_guests_leave_slots_for_the_robot"
        f" {_MASTER}test_hosts_of_a_wildcard_leave_a_named_host_its_slot",
        "binding": f"{_FIREWALL}test_an_address_of_the_machine_is_for_its_own_packets"
        f" {_FIREWALL}test_a_tunnelled_address_is_refused_both_ways_before_all_else",
        "failure": "- a request is read once, and its decision costs a look into tables",
    },
    "node API": {
        "block": "unit/policy/test_policy.py::test_a_block_denies_every_request_of_its_host_alone",
        "end of a right": f"{_RELAY}test_a_connection_ends_with_its_grant_publication_or_node",
        "unknown": "unit/rpc/test_connection_table.py::test_served_connections_of_unknown_hosts_may_make_room",
        "folding": f"{_FOLD}test_varied_addresses_are_folded_together",
        "share": "unit/master/endpoints/test_delivery.py::test_silent_nodes_delay_no_call_to_other_hosts"
        " unit/master/reconcile/test_liveness.py::test_silent_nodes_delay_no_check_of_other_hosts",
        "binding": f"{_FIREWALL}test_the_own_node_is_called_by_control_alone",
        "failure": "unit/master/endpoints/test_delivery.py::test_a_host_loses_only_its_own_calls",
    },
    "relay": {
        "block": "unit/features/blocks/test_block_orders.py::test_a_block_ends_everything_and_what_is_lifted_returns"
        f" {_RELAY}test_a_connection_ends_with_its_grant_publication_or_node",
        "end of a right": f"{_RELAY}test_a_connection_ends_with_its_grant_publication_or_node",
        "unknown": f"{_RELAY}test_unknown_hosts_make_room_for_each_other_and_never_fill_the_relay"
        " unit/relay/test_loop.py::test_all_unknown_hosts_together_are_one_payer"
        f" {_GRANTS}test_hosts_that_only_a_star_names_pay_as_one",
        "folding": f"{_RELAY}test_equal_refusals_are_folded",
        "share": "unit/relay/test_shares.py::test_unfinished_messages_of_a_guest_stop_no_other_host"
        " unit/relay/test_shares.py::test_latched_messages_of_a_guest_stop_no_other_host",
        "binding": f"{_GRANTS}test_a_grant_is_for_one_host_one_caller_one_topic_and_one_incarnation",
        "failure": f"{_RELAY}test_a_publisher_that_always_closes_is_waited_for_ever_longer_until_it_stays",
    },
    "REST with a token": {
        "block": f"{_REST}test_blocks.py::test_every_route_is_closed_for_a_blocked_host"
        " unit/features/standby/test_passive_rest.py::test_a_standby_knows_the_blocked_hosts",
        "end of a right": "unit/master/test_fallen_api.py::test_orders_of_a_revoked_token_are_refused"
        f" {_REST}test_access.py::test_an_expired_token_is_refused",
        "unknown": f"{_REST}test_listener.py::test_a_known_peer_is_opened_before_waiting_unknown_hosts",
        "folding": f"{_REST}test_journal.py::test_equal_reads_are_reported_once_and_counted"
        f" {_REST}test_journal.py::test_a_flood_of_kinds_is_bounded_and_hides_no_other_host",
        "share": f"{_REST}test_listener.py::test_connections_of_one_host_are_limited"
        f" {_REST}test_streams.py::test_a_viewer_with_many_requests_leaves_turns_to_an_admin",
        "binding": f"{_FIREWALL}test_the_rest_port_is_limited_before_its_networks_pass",
        "failure": f"{_REST}test_access.py::test_guessing_a_secret_is_cut_short"
        f" {_REST}test_access.py::test_unknown_tokens_do_not_lock_out_a_neighbour",
    },
    "REST without a token": {
        "block": f"{_REST}test_blocks.py::test_every_route_is_closed_for_a_blocked_host",
        "end of a right": "- an answer without a token is short, and nothing stays open",
        "unknown": f"{_REST}test_listener.py::test_unknown_hosts_in_the_handshake_make_room",
        "folding": f"{_REST}test_journal.py::test_equal_reads_are_reported_once_and_counted",
        "share": f"{_REST}test_listener.py::test_connections_of_one_host_are_limited",
        "binding": f"{_FIREWALL}test_the_rest_port_is_limited_before_its_networks_pass",
        "failure": "unit/features/tunnels/test_enrol_routes.py::test_hosts_that_send_wrong_tokens_have_to_wait",
    },
    "console": {
        "block": f"{_REST}test_blocks.py::test_every_route_is_closed_for_a_blocked_host",
        "end of a right": f"{_SSO}test_sessions.py::test_a_session_ends_in_time_whatever_the_clock_shows",
        "unknown": f"{_REST}test_listener.py::test_a_known_peer_is_opened_before_waiting_unknown_hosts",
        "folding": f"{_REST}test_journal.py::test_equal_reads_are_reported_once_and_counted",
        "share": f"{_REST}test_listener.py::test_connections_of_one_host_are_limited",
        "binding": f"{_REST}test_request_gate.py::test_other_origins_are_refused",
        "failure": "- its files are the same for all; the page asks REST with a token",
    },
    "follower": {
        "block": f"{_REST}test_blocks.py::test_long_answers_end_and_are_stated_to_control",
        "end of a right": f"{_REST}test_access.py::test_a_stream_ends_with_the_grace_time_of_its_token",
        "unknown": "- a follower has a token",
        "folding": f"{_REST}test_journal.py::test_equal_reads_are_reported_once_and_counted",
        "share": f"{_REST}test_streams.py::test_one_token_has_a_quota_and_one_machine_none"
        f" {_REST}test_streams.py::test_two_hundred_viewers_leave_slots_to_operators",
        "binding": f"{_FIREWALL}test_the_rest_port_is_limited_before_its_networks_pass",
        "failure": "- it begins as any request with a token",
    },
    "sign-on": {
        "block": f"{_REST}test_blocks.py::test_every_route_is_closed_for_a_blocked_host",
        "end of a right": f"{_SSO}test_sessions.py::test_other_rights_end_the_earlier_sessions_of_the_person",
        "unknown": f"{_SSO}test_sign_on.py::test_a_flood_of_sign_ons_ends_only_its_own",
        "folding": f"{_SSO}test_sessions.py::test_a_failure_is_answered_and_recorded",
        "share": f"{_SSO}test_sessions.py::test_a_person_and_all_people_have_a_quota_of_sessions"
        f" {_SSO}test_sign_on.py::test_a_flood_of_sign_ons_ends_only_its_own",
        "binding": f"{_SSO}test_sign_on.py::test_a_state_is_good_once_here_and_for_ten_minutes",
        "failure": f"{_SSO}test_sign_on.py::test_the_last_keys_serve_while_the_provider_gives_none_but_not_for_ever"
        f" {_SSO}test_sign_on.py::test_a_provider_that_does_not_answer_is_asked_seldom",
    },
    "door's port": {
        "block": f"{_DOORS}test_process.py::test_a_blocked_host_is_not_served",
        "end of a right": f"{_DOORS}test_conversations.py::test_conversation",
        "unknown": f"{_DOORS}test_door_processes.py::test_refusals_are_denials_of_the_peer_and_connections_are_folded",
        "folding": f"{_DOORS}test_door_processes.py::test_refusals_are_denials_of_the_peer_and_connections_are_folded",
        "share": f"{_DOORS}test_connections.py::test_a_host_leaves_connections_for_others"
        f" {_DOORS}test_lookout.py::test_names_that_never_answer_delay_only_those_of_their_host",
        "binding": f"{_FIREWALL}test_the_addresses_of_doors_are_bound_to_control",
        "failure": f"{_DOORS}test_known_types.py::test_a_definition_that_cannot_be_used_is_parsed_once"
        f" {_DOORS}test_conversations.py::test_conversation",
    },
    "door's ticket": {
        "block": f"{_DOORS}test_door_entry.py::test_a_ticket_opens_a_door_for_hosts_that_are_not_blocked"
        f" {_REST}test_blocks.py::test_a_websocket_of_a_blocked_host_is_refused",
        "end of a right": f"{_DOORS}test_door_table.py::test_a_ticket_opens_one_door_until_its_end"
        f" {_DOORS}test_own_doors.py::test_a_visit_is_one_connection_and_ends_with_its_token",
        "unknown": f"{_DOORS}test_door_entry.py::test_a_ticket_opens_a_door_for_hosts_that_are_not_blocked",
        "folding": f"{_DOORS}test_door_entry.py::test_a_ticket_opens_a_door_for_hosts_that_are_not_blocked",
        "share": f"{_DOORS}test_process.py::test_viewers_that_wait_for_the_node_are_bounded_like_connections",
        "binding": f"{_DOORS}test_session.py::test_only_listed_pages_may_connect"
        f" {_FIREWALL}test_the_addresses_of_doors_are_bound_to_control",
        "failure": f"{_REST}test_shown_tickets.py::test_guessing_tickets_is_cut_short"
        f" {_REST}test_shown_tickets.py::test_a_page_with_an_ended_ticket_keeps_no_neighbour_out",
    },
    "tunnel": {
        "block": f"{_TUNNELS}test_the_tunnel_of_a_blocked_host_is_closed_until_the_block_ends",
        "end of a right": "unit/features/tunnels/test_charon.py::test_unwanted_tunnels_are_closed_at_each_check"
        f" {_TUNNELS}test_a_revoked_host_leaves_the_policy_first",
        "unknown": "unit/ipsec/test_strongswan.py::test_two_hundred_addresses_leave_handshakes_for_hosts",
        "folding": f"{_FOLD}test_varied_addresses_are_folded_together",
        "share": "unit/ipsec/test_strongswan.py::test_two_hundred_addresses_leave_handshakes_for_hosts",
        "binding": f"{_FIREWALL}test_a_tunnelled_address_is_refused_both_ways_before_all_else",
        "failure": f"{_TUNNELS}test_renewals_make_a_host_wait_over_restarts",
    },
    "pair": {
        "block": "- both appliances have keys of the join; an operator ends the pair with `rosrv standby leave`",
        "end of a right": "unit/features/standby/test_two_appliances.py::test_a_replaced_appliance_is_revoked",
        "unknown": "unit/features/standby/test_peer_link.py::test_a_forged_message_is_not_read",
        "folding": "- a datagram without the pair's key is dropped without a record",
        "share": "- one peer, whose messages are bounded by the frame",
        "binding": f"{_FIREWALL}test_replication_and_lease_are_for_the_other_appliance",
        "failure": "unit/features/standby/test_lease.py::test_a_recorded_or_forged_answer_counts_for_nothing",
    },
    "collector": {
        "block": _COLLECTOR,
        "end of a right": "../fleet/tests/unit/test_robots.py::test_a_damaged_file_delays_no_revocation",
        "unknown": "../fleet/tests/unit/test_connections.py::test_unproven_addresses_leave_half_of_the_connections",
        "folding": "- it keeps no audit log of strangers; its acts are recorded one by one",
        "share": "../fleet/tests/unit/test_connections.py::test_room_is_made_by_the_address_with_most"
        " ../fleet/tests/unit/test_connections.py::test_requests_without_a_token_have_a_share",
        "binding": "../fleet/tests/unit/test_server_tls.py::test_certificates_that_a_robot_signed_count_for_no_robot",
        "failure": "../fleet/tests/unit/test_join_routes.py::test_a_sender_of_wrong_tokens_waits_a_minute",
    },
    "admin socket": {
        "block": "- it stays open, so that an operator can lift a block; only accounts of the machine reach it",
        "end of a right": "- the right is that of the file, which the kernel checks at each connection",
        "unknown": "- the mode of the file decides",
        "folding": "- each order is one record, and a query none",
        "share": "- its users are the machine's operators",
        "binding": "- it is a file, without an address",
        "failure": "unit/control/operators/test_admin_socket.py::test_an_order_that_ends_by_a_defect_is_answered",
    },
}

ROLES = {
    "control": "RVMaster, node API, admin socket, pair",
    "relay": "relay",
    "api": "REST with a token, REST without a token, console, follower, door's ticket",
    "door": "door's port, door's ticket",
    "sso": "sign-on",
    "charon": "tunnel",
    "lease": "pair",
    "rosmaster": "- only control reaches it (firewall)",
    "signer": "- only control reaches it",
    "compiler": "- only control reaches it",
    "rosout": "node API",
    "syslog": "- it only sends",
    "hook": "- it only sends",
    "recorder": "- no network",
    "fleet": "- it only sends",
    "bundles": "- it fetches signed files only",
}
"""The entrances of each process."""

LISTENERS = {
    "appliance/control/assembly/listener_limits.py": "RVMaster, node API",
    "appliance/control/operators/admin_socket.py": "admin socket",
    "appliance/control/process.py": "admin socket",
    "appliance/features/doors/door_processes.py": "door's port",
    "appliance/features/doors/process.py": "relay",
    "appliance/features/standby/lease_client.py": "pair",
    "appliance/features/standby/passive.py": "admin socket",
    "appliance/features/standby/process.py": "pair",
    "appliance/features/standby/replication.py": "pair",
    "appliance/features/standby/witness/following.py": "pair",
    "appliance/features/standby/witness/serving.py": "pair",
    "appliance/features/tunnels/charon.py": "- charon's own control socket",
    "appliance/features/tunnels/process.py": "tunnel",
    "appliance/master/endpoints/node_ports.py": "node API, relay",
    "appliance/rpc/acceptor.py": "RVMaster, node API",
    "appliance/rpc/server.py": "RVMaster, node API",
    "appliance/supervisor/lapse_answers.py": "admin socket",
    "appliance/supervisor/run.py": "REST with a token, REST without a token",
    "appliance/features/blocks/orders.py": "- it binds to see whether an address is its own",
    "appliance/features/fleet/process.py": "- the word `listen` is of an event stream that it reads",
    "appliance/features/selftest/live_checks.py": "- nodes of a self-test, for its seconds",
    "appliance/network/firewall/backend_check.py": "- it tries the firewall in a namespace of its own",
    "appliance/network/firewall/rule_watch.py": "- it hears the kernel",
    "appliance/supervisor/port_check.py": "- it binds to see whether a port is free",
    "appliance/supervisor/state_directory.py": "- a lock, not a server",
    "fleet/src/rosrv_fleet/bundles/robot_routes.py": "collector",
    "fleet/src/rosrv_fleet/connections.py": "collector",
    "fleet/src/rosrv_fleet/rollouts/service.py": "collector",
    "fleet/src/rosrv_fleet/server.py": "collector",
    "roswire/node/network.py": "- nodes of tools and of doors, which get their sockets from control",
}
"""The entrances of each file that listens or binds."""

SECRETS = {
    "appliance/signing/bearer_secrets.py": "REST with a token, REST without a token, door's ticket, collector",
    "appliance/signing/request_signing.py": "REST with a token",
    "appliance/api/front/websockets.py": "door's ticket",
    "appliance/control/operators/token_orders.py": "REST with a token",
    "appliance/store/access_tokens.py": "REST with a token",
    "appliance/features/doors/orders.py": "door's ticket",
    "appliance/features/doors/door_visits.py": "door's ticket",
    "appliance/features/sso/sign_on.py": "sign-on",
    "appliance/features/tunnels/enrolment_tokens.py": "REST without a token",
    "appliance/features/standby/first_join.py": "pair",
    "appliance/control/rest/rest_proof.py": "REST with a token",
    "appliance/api/front/access.py": "REST with a token",
    "fleet/src/rosrv_fleet/invitations.py": "collector",
    "fleet/src/rosrv_fleet/tokens.py": "collector",
    "appliance/features/approvals/control_part.py": "- a number, not a secret",
    "appliance/audit/log/ids.py": "- ids",
    "appliance/audit/log/log_database.py": "- an id of the log",
    "appliance/base/atomic_files.py": "- names of files",
    "appliance/features/selftest/live_checks.py": "- names of a self-test",
    "appliance/master/graph/registry.py": "node API",
    "appliance/features/standby/process.py": "- a number, not a secret",
    "appliance/network/esp.py": "- a probe",
    "appliance/store/writer_thread.py": "- an id",
    "appliance/supervisor/monitor_memory.py": "- a name",
}
"""The entrances that secrets of each file open."""

WITHOUT_TOKEN = {
    "/healthz": "REST without a token",
    "/readyz": "REST without a token",
    "/v1/authority": "tunnel",
    "/v1/enrol": "REST without a token",
    "/v1/healthz": "REST without a token",
    "/v1/openapi.html": "REST without a token",
    "/v1/openapi.json": "REST without a token",
    "/v1/readyz": "REST without a token",
    "/v1/revocations": "tunnel",
    "/v1/sso/begin": "sign-on",
    "/v1/sso/complete": "sign-on",
}
"""The entrance of each path that needs no token."""

COLLECTOR_ROUTES = (
    "app.py",
    "bundles/robot_routes.py",
    "console/routes.py",
    "evidence/routes.py",
    "push_routes.py",
    "rollouts/operator_routes.py",
    "search_routes.py",
)
"""The files with routes of the collector; they all come through `connections.py`."""

HOOKS = {
    "own_services.provide": "node API",
    "rest.websocket": "door's ticket",
    "bearers.provide": "sign-on",
    "hosts.provide": "tunnel",
    "links.attach": "- of our own processes",
    "relay.hold": "RVMaster, relay",
}
"""The services of a feature by which others come in; all other services are listed in the test."""


class TakenOut(NamedTuple):
    """A change of the code by which an entrance has a rule no more."""

    entrance: str
    rule: str
    file: str
    old: str
    new: str


def taken_out() -> Iterator[TakenOut]:
    table = tomllib.loads(Path(__file__).with_name("entrance_mutants.toml").read_text(encoding="utf-8"))
    for entrance, rules in table.items():
        for rule, change in rules.items():
            for one in (entrance, *change.get("also", ())):
                yield TakenOut(one, rule, change["file"], change["old"], change["new"])
