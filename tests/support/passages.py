"""The table of passages: all that the appliance has told another program, or keeps for it, at each moment of change.

A cell names the tests of what happens then, or gives the reviewed reason why it cannot be, which begins with `-`. A
test in `unit` works with a double; all others run the deployed processes. `python -m tests.support.passages` lists the
cells that only a double tests: the next findings are there. `tests/unit/test_passages.py` checks the table.
"""

COLUMNS = {
    "first": "its first use",
    "second": "a second one beside it: a subscriber, viewer, source, holder, start",
    "late": "it comes late, or its answer does",
    "lost": "it is lost, and comes back",
    "replaced": "another takes its place under the same name, address or key",
    "twice": "two orders or events for it at once",
    "slow": "its peer reads or answers too slowly",
    "hostile": "a hostile one was first, or fills what is finite",
    "restarted": "the appliance restarts, or is killed",
    "taken over": "another appliance takes over",
    "full": "a disk or a quota is full, and then free again",
}

_FLUSH = "system/network/test_flush.py::"
_ADOPT = "system/network/test_adopt.py::"
_STRANGERS = "system/network/test_adopt_strangers.py::"
_SLOW = "system/network/test_adopt_slow_nodes.py::"
_FIREWALL = "system/network/test_firewall.py::"
_ISOLATION = "system/network/test_isolation.py::"
_LOSSES = "integration/test_losses.py::test_nothing_differs_after_losses_and_returns"
_KILLED = "integration/test_restarts.py::test_kill"
_DOORS = "integration/features/doors/test_running_doors.py::"
_CLIENTS = "integration/features/doors/test_door_clients.py::"
_TYPES = "unit/features/doors/test_known_types.py::"
_TOPICS = "integration/relay/test_topics.py::"
_PLANE = "unit/relay/test_data_plane.py::"
_GUARDS = "integration/features/guards/"
_DRIVE = "unit/features/authority/test_drive_orders.py::"
_APPROVE = "integration/features/approvals/test_approvals.py::"
_ASK = "unit/features/approvals/test_approval_orders.py::"
_PAIR = "system/features/standby/"
_LOG = "integration/test_own_log.py::"
_DISK = "integration/test_full_disk.py::"
_ENDS = "unit/store/test_ends.py::"
_DELIVERY = "unit/master/endpoints/test_delivery.py::"
_TAKE = "unit/features/adopt/test_takeover.py::"
_CERT = "unit/api/front/test_certificate.py::"
_NETNS = "- `isolation: netns` and adoption have no standby"
_OURS = "- the appliance alone makes it, and no peer has another"
_MONITORS = "integration/monitors/test_attacks.py::"
_CRASHES = "integration/master/test_crashes.py::"
_WITNESS = "integration/features/standby/test_witness_firewall.py::"
_SUPERVISOR = "integration/supervisor/test_supervisor.py::"
_LIFECYCLE = "integration/supervisor/test_isolation_lifecycle.py::"
_UP = "integration/supervisor/test_up.py::"
_WATCHDOG = "unit/supervisor/test_isolation_watchdog.py::"
_LEASE = "integration/features/standby/test_lease_process.py::"
_ENROL = "system/ipsec/test_enrolment.py::"
_QUOTAS = "integration/master/test_quotas.py::"
_FLOODS = "integration/master/test_floods.py::"
_AUTHORITY = "integration/features/authority/test_authority.py::"
_TRANSLATED = "system/network/test_translation.py::"
_BEHAVIOUR = "integration/conformance/test_behaviour.py::"
_FAULTS = "integration/conformance/test_faults.py::"

CELLS: dict[str, dict[str, str]] = {
    "firewall rules": {
        "first": f"{_FIREWALL}test_only_control_opens_connections_to_rosmaster"
        f" {_ISOLATION}test_the_end_restores_everything",
        "second": f"{_ISOLATION}test_a_crash_leaves_one_set_after_the_next_start"
        f" {_FIREWALL}test_namespaces_do_not_share_rules",
        "late": f"{_LIFECYCLE}test_failed_rules_are_retried",
        "lost": f"{_FLUSH}test_no_machine_commands_the_base_after_the_rules_are_back"
        f" {_LIFECYCLE}test_removed_rules_are_restored",
        "replaced": f"{_FIREWALL}test_leftovers_of_the_other_back_end_are_replaced",
        "twice": f"{_FIREWALL}test_a_rejected_transaction_keeps_the_old_rules",
        "slow": f"{_LIFECYCLE}test_the_end_does_not_wait_for_a_hanging_check",
        "hostile": f"{_FLUSH}test_only_what_began_without_the_rules_ends"
        f" {_FLUSH}test_nothing_that_reached_a_closed_port_without_the_rules_stays_connected",
        "restarted": f"{_ISOLATION}test_a_crash_leaves_one_set_after_the_next_start",
        "taken over": f"{_WITNESS}test_a_new_holder_resets_the_connections_of_the_old_one",
        "full": f"{_WITNESS}test_a_disk_that_fails_is_the_reason_of_a_refusal",
    },
    "translations": {
        "first": f"{_ISOLATION}test_source_addresses_are_preserved_in_the_namespace",
        "second": f"{_TRANSLATED}test_a_guest_of_the_real_docker_keeps_its_address",
        "late": f"{_ISOLATION}test_the_master_is_forwarded_only_when_it_answers_and_no_other_listens",
        "lost": f"{_FLUSH}test_no_machine_commands_the_base_after_the_rules_are_back",
        "replaced": f"{_TRANSLATED}test_an_earlier_chain_cannot_give_a_guest_the_machines_address",
        "twice": "- one supervisor writes them, in one transaction",
        "slow": "- the kernel applies a transaction as a whole",
        "hostile": f"{_TRANSLATED}test_an_earlier_chain_cannot_give_a_guest_the_machines_address"
        f" {_FLUSH}test_only_what_began_without_the_rules_ends",
        "restarted": f"{_ADOPT}test_an_ordered_stop_gives_the_graph_back_and_a_crash_does_not",
        "taken over": _NETNS,
        "full": "- they are in the kernel, and need no disk",
    },
    "open connections": {
        "first": f"{_TOPICS}test_messages_arrive_with_the_publishers_name",
        "second": f"{_TOPICS}test_a_latched_message_reaches_early_and_late_subscribers_once",
        "late": f"{_SLOW}test_a_publisher_that_tells_its_port_late_is_cut_and_heard",
        "lost": f"{_LOSSES} {_BEHAVIOUR}test_publisher_restarted_again_and_again",
        "replaced": "integration/test_nodes.py::test_second_node_of_a_name_replaces_the_first"
        f" {_STRANGERS}test_a_port_that_an_unknown_host_registered_as_a_service_keeps_its_connections",
        "twice": f"{_FAULTS}test_killed_at_once",
        "slow": f"{_TOPICS}test_a_stopped_subscriber_neither_delays_others_nor_grows_memory",
        "hostile": f"{_QUOTAS}test_connections_to_the_relay",
        "restarted": f"{_KILLED} {_LOSSES}",
        "taken over": f"{_PAIR}test_takeovers.py::test_a_power_cut_of_the_active_appliance"
        f" {_PAIR}test_short_faults.py::test_no_short_fault_ends_a_subscription",
        "full": f"{_QUOTAS}test_connections_of_two_hundred_addresses {_LOSSES}",
    },
    "lists of publishers": {
        "first": "integration/test_nodes.py::test_talker_to_listener",
        "second": f"{_BEHAVIOUR}test_dynamic_subscriptions",
        "late": "integration/master/test_liveness.py::test_a_paused_subscriber_gets_a_new_publisher_when_it_goes_on",
        "lost": f"{_LOSSES}"
        " system/network/test_adopt_kills.py::test_kills_of_control_after_each_step_leave_no_subscriber_deaf",
        "replaced": f"{_BEHAVIOUR}test_killed_node_is_replaced",
        "twice": f"{_FAULTS}test_killed_twice"
        f" {_DELIVERY}test_a_slow_node_gets_only_the_newest_of_the_lists_that_wait",
        "slow": f"{_SLOW}test_a_start_takes_nothing_until_each_node_of_this_computer_answers",
        "hostile": f"{_FLOODS}test_calls_of_a_node_that_never_answers",
        "restarted": f"{_SLOW}test_time_never_goes_back_at_a_start_beside_an_adopted_robot {_KILLED}",
        "taken over": f"{_PAIR}test_shut_out.py::test_nodes_are_back_soon",
        "full": f"{_LOSSES} {_DELIVERY}test_lists_of_publishers_are_bounded_in_bytes",
    },
    "registrations at the robot's own master": {
        "first": f"{_ADOPT}test_cycles_of_adopt_and_release_restart_nothing_and_lose_little",
        "second": f"{_ADOPT}test_cycles_of_adopt_and_release_restart_nothing_and_lose_little",
        "late": f"{_ADOPT}test_a_service_that_waits_for_the_robots_master_takes_its_graph_over",
        "lost": "system/network/test_adopt_computers.py::test_the_first_computer_reboots_alone",
        "replaced": f"{_TAKE}test_a_foreign_master_gets_nothing_and_the_nodes_keep_their_topics",
        "twice": f"{_TAKE}test_kills_in_the_middle_of_both_change_nothing_of_the_end",
        "slow": f"{_SLOW}test_a_start_takes_nothing_until_each_node_of_this_computer_answers",
        "hostile": f"{_STRANGERS}test_names_of_an_unknown_host_keep_no_node_of_the_robot_out"
        f" {_FLUSH}test_no_machine_commands_the_base_after_the_rules_are_back",
        "restarted": f"{_ADOPT}test_a_kill_of_everything_in_the_middle_ends_as_ordered",
        "taken over": _NETNS,
        "full": f"{_TAKE}test_a_subscriber_stays_with_the_own_master_until_it_is_on_the_disk",
    },
    "types at doors": {
        "first": f"{_CLIENTS}test_a_rosbridge_client_hears_publishes_and_calls",
        "second": f"{_CLIENTS}test_a_guest_defines_no_type_for_another_topic",
        "late": f"{_CLIENTS}test_a_foxglove_viewer_gets_the_bytes_of_messages",
        "lost": f"{_CLIENTS}test_a_guest_defines_no_type_for_another_topic",
        "replaced": f"{_CLIENTS}test_a_guest_defines_no_type_for_another_topic",
        "twice": f"{_TYPES}test_a_definition_is_not_that_of_an_equal_md5sum",
        "slow": "unit/features/doors/test_lookout.py::test_names_that_never_answer_delay_only_those_of_their_host",
        "hostile": f"{_CLIENTS}test_a_guest_defines_no_type_for_another_topic",
        "restarted": f"{_LOSSES} {_DOORS}test_doors_survive_a_restart_and_a_removed_one_ends",
        "taken over": f"{_PAIR}test_features.py::test_a_door_a_held_group_and_guards",
        "full": f"{_LOSSES} {_TYPES}test_many_large_definitions_are_forgotten_in_order",
    },
    "grants in relays": {
        "first": "integration/master/test_attacks.py::test_granted_topic_arrives",
        "second": f"{_TOPICS}test_a_connection_is_for_one_topic",
        "late": f"{_PLANE}test_a_grant_is_compared_with_the_waiting_peers_of_its_host",
        "lost": f"{_TOPICS}test_a_revocation_closes_its_connection {_LOSSES}",
        "replaced": f"{_TOPICS}test_a_republished_topic_is_served_again",
        "twice": f"{_LOSSES} unit/relay/test_grant_table.py::test_a_withdrawal_during_a_restatement_stays",
        "slow": f"{_LOSSES} {_ASK}test_a_relay_that_hangs_delays_the_end_of_no_other_approval",
        "hostile": "integration/master/test_attacks.py::test_permission_of_another_host",
        "restarted": f"{_TOPICS}test_a_connection_that_a_new_control_does_not_restate_is_closed"
        " integration/test_policy_changes.py::test_revocations_survive_a_crash_of_control",
        "taken over": f"{_PAIR}test_takeovers.py::test_a_power_cut_of_the_active_appliance",
        "full": f"{_DISK}test_a_revocation_is_effective_even_if_it_cannot_be_stored",
    },
    "sources awaited by monitors": {
        "first": f"{_GUARDS}test_guarded_robot.py::test_a_robot_moves_again_after_each_act",
        "second": "integration/monitors/test_scenarios.py::test_all_monitors_together",
        "late": f"{_GUARDS}test_guarded_robot.py::test_a_robot_moves_again_after_each_act",
        "lost": f"{_GUARDS}test_guarded_robot.py::test_a_robot_moves_again_after_each_act"
        f" {_GUARDS}test_new_state.py::test_a_base_that_goes_silent_is_stopped_with_a_new_state_directory",
        "replaced": f"{_GUARDS}test_bypass.py::test_a_base_that_takes_commands_past_its_guard_is_an_alarm",
        "twice": f"{_MONITORS}test_a_relay_killed_while_specifications_are_loaded",
        "slow": f"{_GUARDS}test_guarded_robot.py::test_a_large_scanner_stops_no_robot",
        "hostile": f"{_MONITORS}test_monitor_changes_under_a_flood_lose_only_counted_messages",
        "restarted": "integration/monitors/test_emergency_stop.py::test_a_latched_stop_stays",
        "taken over": f"{_PAIR}test_monitor_state.py::test_a_guarded_base_moves_again",
        "full": "- a monitor awaits a message, which needs neither disk nor quota of its own",
    },
    "leases": {
        "first": f"{_AUTHORITY}test_one_host_at_a_time_is_heard",
        "second": f"{_AUTHORITY}test_one_host_at_a_time_is_heard",
        "late": f"{_LOSSES} {_DRIVE}test_nothing_is_handed_over_while_a_relay_starts",
        "lost": f"{_LOSSES} {_PAIR}test_takeovers.py::test_a_lapse_of_the_lease",
        "replaced": f"{_LEASE}test_a_greater_epoch_of_the_other_appliance_ends_its_own",
        "twice": "integration/features/authority/test_rank.py::test_a_hundred_hand_overs_are_quick_and_never_mixed",
        "slow": f"{_LEASE}test_a_holder_that_does_not_serve_gives_the_lease_away"
        f" {_DRIVE}test_a_relay_that_hangs_delays_the_end_of_no_other_group",
        "hostile": f"{_LEASE}test_garbage_and_forgeries_change_nothing"
        " unit/features/authority/test_group_holders.py::test_hosts_that_may_only_ask_keep_no_driver_from_waiting",
        "restarted": f"{_LOSSES} {_LEASE}test_a_damaged_epoch_file_keeps_it_passive",
        "taken over": f"{_PAIR}test_features.py::test_a_door_a_held_group_and_guards",
        "full": f"{_PAIR}test_full_disks.py::test_two_nearly_full_disks",
    },
    "approvals": {
        "first": f"{_APPROVE}test_a_call_is_held_approved_used_once_and_held_again",
        "second": f"{_APPROVE}test_a_call_is_held_approved_used_once_and_held_again",
        "late": f"{_ASK}test_a_call_without_an_answer_ends_with_an_alarm",
        "lost": f"{_LOSSES} {_APPROVE}test_a_publication_lasts_for_its_time",
        "replaced": f"{_APPROVE}test_a_door_that_is_added_again_has_no_approval",
        "twice": f"{_ASK}test_no_operator_replaces_the_answer_of_another_unseen",
        "slow": f"{_LOSSES} {_ASK}test_a_relay_that_hangs_delays_the_end_of_no_other_approval",
        "hostile": f"{_LOSSES} {_ASK}test_many_addresses_leave_another_host_its_calls",
        "restarted": f"{_APPROVE}test_a_call_is_held_approved_used_once_and_held_again",
        "taken over": f"{_ENDS}test_each_stored_end_keeps_its_time_over_takeovers",
        "full": f"{_ENDS}test_on_a_full_disk_each_thing_ends",
    },
    "counters": {
        "first": "integration/test_denials.py::test_denials_of_unknown_and_blocked_hosts_count",
        "second": f"{_LOSSES}",
        "late": f"{_PLANE}test_a_second_is_reported_although_tidying_up_takes_many_turns",
        "lost": f"{_LOSSES}",
        "replaced": f"{_LOSSES}",
        "twice": f"{_FAULTS}test_killed_at_once",
        "slow": f"{_FLOODS}test_calls_of_a_node_that_never_answers",
        "hostile": "integration/master/test_audit_quotas.py::test_unknown_hosts_do_not_displace_denials_of_named_hosts",
        "restarted": f"{_LOSSES}",
        "taken over": f"{_PAIR}test_random_faults.py::test_random_faults_break_no_promise",
        "full": "integration/master/test_audit_quotas.py::test_reads_with_long_keys_do_not_fill_the_disk",
    },
    "timers": {
        "first": f"{_APPROVE}test_a_publication_lasts_for_its_time",
        "second": f"{_ENDS}test_each_thing_has_its_time",
        "late": f"{_ENDS}test_time_off_that_counts_later_takes_no_time_from_a_later_beginning",
        "lost": "integration/supervisor/test_clock.py::test_a_clock_that_was_set_back_while_the_appliance_was_off",
        "replaced": f"{_ENDS}test_a_clock_that_is_set_while_control_runs_ends_credentials_early_and_moves_no_other_end",
        "twice": f"{_ENDS}test_a_kill_at_any_write_gives_no_thing_the_end_of_another",
        "slow": f"{_LOSSES} {_ASK}test_a_relay_that_hangs_delays_the_end_of_no_other_approval",
        "hostile": f"{_ENDS}test_a_fault_of_one_owner_keeps_no_other_end",
        "restarted": f"{_LOSSES} {_ENDS}test_no_restart_gives_an_end_more_time",
        "taken over": f"{_PAIR}test_stored_ages.py::test_a_block_keeps_its_length_over_switchovers",
        "full": f"{_ENDS}test_on_a_full_disk_each_thing_ends",
    },
    "threads": {
        "first": f"{_LOSSES}",
        "second": f"{_LOSSES}",
        "late": "- none waits for a peer without an end: the row `open connections`",
        "lost": f"{_LOG}test_nothing_that_reports_fails_without_room {_LOSSES}",
        "replaced": _OURS,
        "twice": f"{_LOSSES}",
        "slow": f"{_WATCHDOG}test_no_restoration_waits_for_the_end_of_connections",
        "hostile": f"{_WATCHDOG}test_a_crowd_of_new_hosts_costs_a_few_threads",
        "restarted": f"{_LOSSES} {_SUPERVISOR}test_a_clean_end_leaves_nothing",
        "taken over": f"{_PAIR}test_takeovers.py::test_the_death_of_one_process",
        "full": f"{_LOG}test_a_full_disk_of_state_and_log_has_an_end",
    },
    "sockets": {
        "first": f"{_UP}test_it_says_when_nodes_may_connect_and_ends_cleanly_in_time",
        "second": f"{_SUPERVISOR}test_a_second_appliance_on_the_same_state_is_refused",
        "late": f"{_UP}test_a_service_waits_for_a_held_port_and_says_so",
        "lost": f"{_SUPERVISOR}test_a_port_of_control_stays_open_while_control_is_dead {_LOSSES}",
        "replaced": f"{_CRASHES}test_another_program_took_a_nodes_port_while_the_appliance_was_off",
        "twice": f"{_LOSSES}",
        "slow": f"{_DOORS}test_a_client_that_does_not_finish_a_message_is_disconnected_and_recorded",
        "hostile": "integration/master/test_accept_queues.py::test_a_full_queue_of_unknown_hosts"
        f" {_QUOTAS}test_handshakes_with_rest",
        "restarted": f"{_SUPERVISOR}test_every_port_of_a_large_robot_survives_control {_LOSSES}",
        "taken over": f"{_PAIR}test_takeovers.py::test_a_port_of_an_earlier_connection_can_be_used_again",
        "full": f"{_QUOTAS}test_connections_of_two_hundred_addresses {_LOSSES}",
    },
    "certificates": {
        "first": f"{_ENROL}test_a_laptop_joins_renews_and_leaves",
        "second": "system/ipsec/test_attacks.py::test_two_hosts_with_one_certificate",
        "late": f"{_ENROL}test_a_short_lived_certificate_is_renewed_in_time",
        "lost": "system/ipsec/test_endurance.py::test_both_ends_restart",
        "replaced": "system/ipsec/test_tunnels.py::test_a_replaced_certificate_is_revoked",
        "twice": f"{_ENROL}test_revocation_while_rekeying",
        "slow": f"{_ENROL}test_two_hundred_hosts_beside_a_tunnel",
        "hostile": f"{_ENROL}test_a_man_in_the_middle_gets_nothing",
        "restarted": f"{_CERT}test_it_is_reused_and_only_its_owner_reads_the_key"
        " system/containers/test_life.py::test_a_recreated_container_keeps_its_certificate",
        "taken over": f"{_PAIR}test_two_appliances.py::test_revoked_certificates_and_new_ones",
        "full": "unit/hosts/test_revoked_certificates.py::test_a_full_list_says_when_it_has_space_again",
    },
    "the program's log": {
        "first": f"{_UP}test_it_says_when_nodes_may_connect_and_ends_cleanly_in_time",
        "second": "- each process writes to its own descriptor",
        "late": f"{_LOG}test_nothing_that_reports_fails_without_room",
        "lost": f"{_LOG}test_nothing_that_reports_fails_without_room",
        "replaced": f"{_LOG}test_every_process_is_started_again",
        "twice": "- a line is one write",
        "slow": f"{_LOG}test_nothing_that_reports_fails_without_room",
        "hostile": "unit/texts/test_hostile_texts.py::test_a_line_of_the_log_is_one_line",
        "restarted": f"{_LOG}test_every_process_is_started_again",
        "taken over": "- it is the machine's, and no other appliance reads it",
        "full": f"{_LOG}test_a_full_disk_of_state_and_log_has_an_end",
    },
}


def named_tests(cell: str) -> list[str]:
    return [] if cell.startswith("- ") else cell.split()


def only_doubles() -> list[str]:
    """Return the cells of which no test runs the deployed processes."""
    return [
        f"{row} / {column}"
        for row, cells in CELLS.items()
        for column, cell in cells.items()
        if named_tests(cell) and all(test.startswith("unit/") for test in named_tests(cell))
    ]


if __name__ == "__main__":
    print(*only_doubles(), sep="\n")  # noqa: T201  its result
