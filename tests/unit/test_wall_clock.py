"""Durations use the monotonic clock, because the machine's date may be set while a robot runs."""

import ast
from pathlib import Path

from tests.support.sources import ROOT, product_files

READERS = {
    "a moment that people are shown, or that stands in a file": [
        "api/history.py", "audit/ids.py", "audit/log.py", "telemetry/audit_trail.py", "backup/create.py",
        "bundles/poller.py", "control/bundle_gate.py",
        "cli/standby/second_join.py", "cli/status_watch.py", "control/host_blocks.py", "control/passive.py",
        "control/policies.py", "control/queries.py", "control/replication.py",
        "control/recording_orders.py", "evidence/bundle.py", "forwarding/log_forwarder.py",
        "forwarding/segment_pusher.py",
        "hosts/checked_ports.py", "hosts/host_table.py", "hosts/shared_authority.py",
        "recorder/recorder.py", "recorder/ring.py", "relay/topic_taps.py", "relay/monitors/interceptor.py",
        "relay/recorder_ring.py",
        "specifications/specification_manager.py", "supervisor/process_handle.py", "supervisor/monitor_memory.py",
        "supervisor/rings.py", "supervisor/supervisor.py",
    ],
    "an end that is a date: of a certificate, a token, a revocation": [
        "api/access.py", "api/metrics_route.py", "api/process.py", "cli/selftest/file_checks.py", "cli/token.py",
        "bundles/verified_bundles.py",
        "control/passive_rest.py", "control/token_orders.py", "hosts/appliance_table.py",
        "hosts/certification.py", "hosts/enrolment_tokens.py",
        "hosts/revoked_certificates.py", "hosts/tunnel_state.py", "hosts/view.py", "ipsec/certificate_authority.py",
        "signing/own_certificate.py",
    ],
    "a span that goes on over restarts of the machine, which has no other clock": [
        "control/switched_off.py", "hosts/self_service.py", "specifications/timed_disables.py", "store/revisions.py",
    ],
    "whether the wall clock can be believed": [
        "base/age_clock.py", "base/shipped.py", "control/clock_check.py",
    ],
    "a moment that people ask for (`--since 1h`), or a page that is shown once": [
        "api/alarms.py", "api/moments.py", "audit/filter_options.py", "cli/evidence_verbs.py", "cli/monitor/offline.py",
        "cli/monitor/recorder_input.py", "cli/policy/learn_verb.py", "cli/protect_verb.py", "cli/record_verbs.py",
        "cli/status_verb.py", "cli/topic_verbs.py",
    ],
}  # fmt: skip
"""The files that read the wall clock, by purpose. Add a file only if it has one of these purposes."""

_WALL = {("time", "time"), ("time", "time_ns"), ("time", "CLOCK_REALTIME")} | {
    (of, call) for of in ("datetime", "date") for call in ("now", "utcnow", "today")
}


def _reads_wall_clock(path: Path) -> bool:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "time":
            return True  # a bare `time()` does not reveal which clock is used
        if isinstance(node, ast.Attribute):
            of = node.value.attr if isinstance(node.value, ast.Attribute) else getattr(node.value, "id", "")
            if (of, node.attr) in _WALL:
                return True
    return False


def test_only_these_files_read_the_wall_clock() -> None:
    """In any other file, a timeout, expiry or duration would be wrong after the clock is set."""
    found = {str(path.relative_to(ROOT)) for path in product_files() if _reads_wall_clock(path)}
    assert found == {f"appliance/{file}" for files in READERS.values() for file in files}
