import os
from collections.abc import Sequence
from typing import Any

from prometheus_client.parser import text_string_to_metric_families

from appliance.base import clock
from appliance.base.metric import BOUNDS
from appliance.channel.answers.measures import Measures
from appliance.features.metrics.metric_table import METRICS
from appliance.features.metrics.routes import render
from appliance.telemetry.audit_trail import Meter
from tests.support.answers import example

CALLS = {("GET", "200"): 8}


def body(processes: Sequence[dict[str, Any]] = ({"role": "control", "pid": 1, "restarts": 4},)) -> Measures:
    meter = Meter()
    for seconds in (0.0003, 99.0):
        meter.decisions["publish", "deny"] += 1
        meter.decision_seconds.observe(seconds)
    meter.count_call("getPid", 0.002)
    return example(
        Measures,
        decisions=[(*labels, count) for labels, count in meter.decisions.items()],
        decision_seconds=meter.decision_seconds.values(),
        calls=[(call, one.values()) for call, one in meter.calls.items()],
        status={
            "version": "1", "since": 5.0, "relay": "1 of 2 are away", "rosmaster": "reachable", "probe": "it answers",
            "ipsec": {"troubles": ["a", "b"]},
            "policy": {"revision": 3, "differs_from_file": True},
            "monitors": {"loaded": 3, "enabled": 2, "held": ["b"], "failing": []},
            "audit": {"lag_records": 2, "lag_seconds": 0.5, "degraded": "fsync"},
            "processes": list(processes),
        },
        queued_deliveries=6,
        nodes={"live": 2, "lost": 1},
        registrations={"publication": 3},
        monitors=[("drop", "safeTrigger", 4)],
        slices={"goals": (12, 100)},
        relayed={"/a\"\\\n": [1, 2, 3]},
        delayed={"/a": [5, 4, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0.25]},
        drop_at={"/b": 5}, change_at={"/b": 6, "(others)": 1},
        connections={"topic": 7},
        memory={"latched": 12},
        limited=[("/scan", "publisher", 3)],
        hosts=[
            host("a", "up", remote="10.0.0.9", seconds=7, bytes_in=100, bytes_out=50, expires=clock.wall() + 1000),
            host("b", "revoked", revoked=5.0),
            host("c", "not enrolled", serial=None),
        ],
    )  # fmt: skip


def host(name: str, state: str, **more: Any) -> dict[str, Any]:
    return {"name": name, "state": state, "serial": "1f", "expires": 9.0, "ports": {"state": "closed"}} | more


def test_every_metric_is_exported_as_listed() -> None:
    families = {one.name: one for one in text_string_to_metric_families(render(body(), CALLS).decode())}
    for metric in METRICS:
        family = families[metric.name.removesuffix("_total")]
        assert family.type == metric.kind
        assert family.documentation == metric.help
        for sample in family.samples:
            assert set(sample.labels) - {"le"} == set(metric.labels), sample


def exported() -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Return the values by name and labels."""
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(render(body(), CALLS).decode())
        for sample in family.samples
    }


def test_values_are_exported() -> None:
    samples = exported()
    assert samples["rosrv_decisions_total", (("category", "publish"), ("outcome", "deny"))] == 2
    assert samples["rosrv_decision_seconds_count", ()] == 2
    assert samples["rosrv_monitor_events_total", (("kind", "drop"), ("monitor", "safeTrigger"))] == 4
    goals = (("monitor", "goals"),)
    assert samples["rosrv_monitor_slices", goals] == 12
    assert samples["rosrv_monitor_slice_limit", goals] == 100
    assert samples["rosrv_monitors", (("state", "disabled"),)] == 1
    assert samples["rosrv_decision_seconds_bucket", (("le", "0.00025"),)] == 0
    assert samples["rosrv_decision_seconds_bucket", (("le", "0.0005"),)] == 1
    assert samples["rosrv_decision_seconds_bucket", (("le", str(BOUNDS[-1])),)] == 1
    assert samples["rosrv_decision_seconds_bucket", (("le", "+Inf"),)] == 2
    assert samples["rosrv_relay_bytes_total", (("resource", '/a"\\\n'),)] == 2
    topic = ("resource", "/a")
    assert samples["rosrv_relay_delay_seconds_bucket", (("le", "5e-05"), topic)] == 5
    assert samples["rosrv_relay_delay_seconds_bucket", (("le", "0.0001"), topic)] == 9
    assert samples["rosrv_relay_delay_seconds_bucket", (("le", "+Inf"), topic)] == 10
    assert samples["rosrv_relay_delay_seconds_sum", (topic,)] == 0.25
    assert samples["rosrv_audit_failed", ()] == 0
    assert samples["rosrv_audit_degraded", ()] == 1
    assert samples["rosrv_probe_failed", ()] == 1
    assert samples["rosrv_ipsec_troubles", ()] == 2
    assert samples["rosrv_relay_connected", ()] == 0
    assert samples["rosrv_monitor_dropped_total", (("resource", "/b"),)] == 5
    assert samples["rosrv_monitor_changed_total", (("resource", "(others)"),)] == 1
    assert samples["rosrv_process_resident_bytes", (("role", "control"),)] > 0


def test_tunnels_are_measured() -> None:
    samples = exported()
    a = (("host", "a"),)
    assert samples["rosrv_tunnel_up", a] == 1
    assert samples["rosrv_tunnel_age_seconds", a] == 7
    assert samples["rosrv_tunnel_bytes", (("direction", "in"), *a)] == 100
    assert 900 < samples["rosrv_host_certificate_expiry_seconds", a] <= 1000
    assert samples["rosrv_host_ports_open", a] == 0
    assert samples["rosrv_hosts", (("state", "revoked"),)] == 1
    assert ("rosrv_tunnel_up", (("host", "b"),)) not in samples


def test_processes_of_one_role_have_separate_series() -> None:
    answer = body([{"role": "relay", "pid": os.getpid(), "restarts": restarts} for restarts in (1, 2)])
    lines = [line for line in render(answer, CALLS).decode().splitlines() if line.startswith("rosrv_process")]
    assert len({line.rsplit(" ", 1)[0] for line in lines}) == len(lines) == 4
    assert 'rosrv_process_restarts_total{role="relay 1"} 2.0' in lines
