"""Answer `/metrics` in Prometheus's format."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.core import Metric as Family
from prometheus_client.registry import Collector
from prometheus_client.utils import floatToGoString
from starlette.responses import Response

from appliance.api.front.problems import ProblemError
from appliance.api.front.route_roles import Viewer, ask
from appliance.api.front.routing import Routes, file
from appliance.api.front.services import Services
from appliance.base import clock
from appliance.base.metric import Metric
from appliance.channel.admin import MetricsWanted
from appliance.channel.answers.host_answers import Host
from appliance.channel.answers.measures import Measures
from appliance.channel.answers.status import ProcessInfo
from appliance.channel.status_summary import no_relay, probe_failed, process_names
from appliance.features.metrics.metric_table import METRICS
from appliance.features.views import STATES, pair_view, states_of

_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_Samples = Iterable[tuple[tuple[str, ...], Any]]
_TEXT = file("text/plain", "Prometheus's text format")


def routes(services: Services) -> Routes:
    router = Routes(tags=["metrics"])

    async def metrics(bearer: Viewer) -> Response:
        """Return the metrics in Prometheus's text format; docs/reference/metrics.md lists them."""
        calls = services.journal.calls
        try:
            page = render(await ask(services.control, MetricsWanted(), bearer), calls)
        except ProblemError as problem:
            if problem.kind != "standby":
                raise
            wanted = resolve_name(pair_view().request)()
            page = rendered_standby(await ask(services.control, wanted, bearer), calls)
        return Response(page, media_type=CONTENT_TYPE_LATEST)

    for prefix, name in (("", ""), ("/v1", "_v1")):
        router.add_api_route(
            f"{prefix}/metrics",
            metrics,
            operation_id=f"metrics{name}",
            responses=_TEXT,
            response_class=Response,
        )
    return router


def render(body: Measures, calls: Mapping[tuple[str, str], int]) -> bytes:
    return page({**_samples(body), "rosrv_rest_calls_total": calls.items()}, METRICS)


def rendered_standby(state: Any, calls: Mapping[tuple[str, str], int]) -> bytes:
    """Return the metrics of a standby, which has only its own state and the numbers of REST calls."""
    samples = {**pair_view().samples(state), "rosrv_rest_calls_total": calls.items()}
    return page(samples, [metric for metric in METRICS if metric.name in samples])


def page(samples: Mapping[str, _Samples], metrics: Iterable[Metric]) -> bytes:
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Once([_family(metric, samples[metric.name]) for metric in metrics]))
    return generate_latest(registry)


class _Once(Collector):
    def __init__(self, families: Sequence[Family]) -> None:
        self._families = families

    def collect(self) -> Iterator[Family]:
        yield from self._families


def _family(metric: Metric, samples: _Samples) -> Family:
    if metric.kind == "histogram":
        histogram = HistogramMetricFamily(metric.name, metric.help, labels=metric.labels)
        for labels, (counts, total) in samples:
            histogram.add_metric(labels, _buckets(metric.bounds, counts), total)
        return histogram
    kind = CounterMetricFamily if metric.kind == "counter" else GaugeMetricFamily
    family = kind(metric.name, metric.help, labels=metric.labels)
    for labels, value in samples:
        family.add_metric(labels, float(value))
    return family


def _buckets(bounds: Sequence[float], counts: Sequence[float]) -> list[tuple[str, float]]:
    total: float = 0
    buckets = []
    for bound, count in zip([*map(floatToGoString, bounds), "+Inf"], counts, strict=True):
        total += count
        buckets.append((bound, float(total)))
    return buckets


def _samples(body: Measures) -> dict[str, _Samples]:
    status = body.status
    policy, audit, monitors, clock = status.policy, status.audit, status.monitors, status.clock
    relayed = body.relayed
    return {
        "rosrv_info": [((status.version, status.name), 1)],
        "rosrv_start_time_seconds": [((), status.since)],
        "rosrv_decisions_total": [
            ((category, outcome), count) for category, outcome, count in body.decisions
        ],
        "rosrv_decision_seconds": [((), body.decision_seconds)],
        "rosrv_master_call_seconds": [((call,), observed) for call, observed in body.calls],
        "rosrv_probe_failed": [((), probe_failed(status))],
        "rosrv_relay_connected": [((), no_relay(status.relay) is None)],
        "rosrv_relay_connections": [((kind,), count) for kind, count in body.connections.items()],
        "rosrv_relay_messages_total": [((name,), row[0]) for name, row in relayed.items()],
        "rosrv_relay_bytes_total": [((name,), row[1]) for name, row in relayed.items()],
        "rosrv_relay_dropped_total": [((name,), row[2]) for name, row in relayed.items()],
        "rosrv_relay_limited_total": [((name, part), count) for name, part, count in body.limited],
        "rosrv_relay_memory_bytes": [((what,), size) for what, size in body.memory.items()],
        "rosrv_relay_delay_seconds": [((name,), (row[:-1], row[-1])) for name, row in body.delayed.items()],
        "rosrv_monitor_dropped_total": [((name,), count) for name, count in body.drop_at.items()],
        "rosrv_monitor_changed_total": [((name,), count) for name, count in body.change_at.items()],
        "rosrv_monitor_events_total": [((kind, name), count) for kind, name, count in body.monitors],
        "rosrv_monitor_slices": [((name,), count) for name, (count, _) in body.slices.items()],
        "rosrv_monitor_slice_limit": [((name,), most) for name, (_, most) in body.slices.items()],
        "rosrv_switched_off": [
            (
                (about, state),
                sum((off.about, off.forgotten) == (about, forgotten) for off in status.switched_off),
            )
            for about in ("monitors", "policy")
            for state, forgotten in (("recent", False), ("forgotten", True))
        ],
        "rosrv_monitors": [
            (("enabled",), monitors.enabled),
            (("shadow",), len(monitors.shadow)),
            (("disabled",), monitors.loaded - monitors.enabled - len(monitors.shadow)),
            (("holding",), len(monitors.held)),
            (("failing",), len(monitors.failing)),
            (("broken",), len(monitors.left_out)),
        ],
        "rosrv_nodes": [((state,), count) for state, count in body.nodes.items()],
        "rosrv_registrations": [((kind,), count) for kind, count in body.registrations.items()],
        "rosrv_rosmaster_reachable": [((), status.rosmaster == "reachable")],
        "rosrv_delivery_queue": [((), body.queued_deliveries)],
        **_tunnels(body.hosts),
        "rosrv_hosts_blocked": [((), status.blocks.hosts)],
        "rosrv_ipsec_troubles": [((), len(status.ipsec.troubles))],
        "rosrv_audit_queue": [((), audit.lag_records)],
        "rosrv_audit_lag_seconds": [((), audit.lag_seconds)],
        "rosrv_audit_failed": [((), audit.failed is not None)],
        "rosrv_audit_degraded": [((), audit.degraded is not None)],
        "rosrv_clock_synchronised": [((), -1 if clock.synchronised is None else clock.synchronised)],
        "rosrv_clock_behind_seconds": [((), clock.behind_seconds)],
        **{metric.name: [] for view in STATES for metric in view.metrics},
        **{name: rows for view, state in states_of(status) for name, rows in view.samples(state).items()},
        "rosrv_policy_revision": [((), policy.revision)],
        "rosrv_policy_differs_from_file": [((), policy.differs_from_file)],
        "rosrv_process_restarts_total": [
            ((name,), process.restarts) for name, process in _named(status.processes)
        ],
        "rosrv_process_resident_bytes": list(_memory(status.processes)),
    }


_PORTS = {"open": 1, "closed": 0, "unknown": -1}


def _tunnels(hosts: list[Host]) -> dict[str, _Samples]:
    enrolled = [host for host in hosts if host.serial is not None and host.revoked is None]
    now = clock.wall()
    return {
        "rosrv_tunnel_up": [((host.name,), host.remote is not None) for host in enrolled],
        "rosrv_tunnel_age_seconds": [((host.name,), host.seconds or 0) for host in enrolled],
        "rosrv_tunnel_bytes": [
            ((host.name, direction), count or 0)
            for host in enrolled
            for direction, count in (("in", host.bytes_in), ("out", host.bytes_out))
        ],
        "rosrv_host_certificate_expiry_seconds": [
            ((host.name,), host.expires - now) for host in enrolled if host.expires is not None
        ],
        "rosrv_host_ports_open": [((host.name,), _PORTS[host.ports.state]) for host in enrolled],
        "rosrv_hosts": [((state,), count) for state, count in Counter(host.state for host in hosts).items()],
    }


def _named(processes: Sequence[ProcessInfo]) -> Iterator[tuple[str, ProcessInfo]]:
    """Give each process a unique name, because a role may have two processes."""
    return zip(process_names(processes), processes, strict=True)


def _memory(processes: Sequence[ProcessInfo]) -> Iterator[tuple[tuple[str, ...], float]]:
    for name, process in _named(processes):
        try:
            pages = Path(f"/proc/{process.pid}/statm").read_text().split()[1]
        except OSError:
            continue  # the process has just ended
        yield (name,), float(int(pages) * _PAGE_BYTES)
