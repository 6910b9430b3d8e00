"""Durations use the monotonic clock, because the date may be set while a robot runs; all clocks have one source."""

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
    "whether the wall clock can be believed, and where it is read": [
        "base/age_clock.py", "base/clock.py", "base/shipped.py", "control/clock_check.py",
    ],
    "a moment that people ask for (`--since 1h`), or a page that is shown once": [
        "api/alarms.py", "api/moments.py", "audit/filter_options.py", "cli/evidence_verbs.py", "cli/monitor/offline.py",
        "cli/monitor/recorder_input.py", "cli/policy/learn_verb.py", "cli/protect_verb.py", "cli/record_verbs.py",
        "cli/status_verb.py", "cli/topic_verbs.py",
    ],
}  # fmt: skip
"""The files that read the wall clock, by purpose. Add a file only if it has one of these purposes."""

_WALL = {"wall", "wall_ns", "utc_now"}
_DIRECT = {
    "base/clock.py": "offers the clocks of the operating system to the rest",
    "standby/witness.py": "is copied to a machine without the appliance",
    "audit/log.py": "has a thread, which `clock.using` does not reach",
}
_CLOCKS = {"time", "time_ns", "localtime", "gmtime", "ctime"} | {
    f"{clock}{unit}" for clock in ("monotonic", "perf_counter", "clock_gettime") for unit in ("", "_ns")
}


def _reads(path: Path) -> tuple[bool, bool]:
    """Whether a file reads the wall clock, and whether it reads any clock but that of `base/clock.py`."""
    wall = direct = False
    for node in ast.walk(ast.parse(path.read_text())):
        match node:
            case ast.ImportFrom(module="time"):
                direct = True  # a bare `time()` does not reveal which clock is used
            case ast.ImportFrom(module="appliance.base.clock", names=names):
                wall = wall or any(alias.name in _WALL for alias in names)
            case ast.Attribute(value=ast.Name(id="clock"), attr=name):
                wall = wall or name in _WALL
            case ast.Attribute(value=ast.Name(id="time"), attr=name):
                direct = direct or name in _CLOCKS
                wall = wall or name in ("time", "time_ns")
            case ast.Attribute(value=ast.Name(id=of) | ast.Attribute(attr=of), attr=name):
                direct = direct or (of in ("datetime", "date") and name in ("now", "utcnow", "today"))
    return wall, direct


def test_only_these_files_read_the_wall_clock() -> None:
    """In any other file, a timeout, expiry or duration would be wrong after the clock is set."""
    found = {str(path.relative_to(ROOT)) for path in product_files() if _reads(path)[0]}
    assert found == {f"appliance/{file}" for files in READERS.values() for file in files}


def test_every_other_file_reads_its_clocks_from_base_clock() -> None:
    """A test and a simulation set all clocks of a machine in one place."""
    found = {
        str(path.relative_to(top))
        for top in (ROOT / "appliance", ROOT / "fleet/rosrv_fleet")
        for path in top.rglob("*.py")
        if _reads(path)[1]
    }
    assert found == _DIRECT.keys()
