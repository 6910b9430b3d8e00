"""The metrics of bundles and rollouts: labels are site, group and a few states, so robots cannot fill Prometheus."""

from collections.abc import Iterator

from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector as MetricSource

from appliance.base import clock
from rosrv_fleet.rollouts.operator_routes import group_state
from rosrv_fleet.rollouts.service import BundleService

_STATES = ("running", "stopped", "reverted", "done")


class RolloutMetrics(MetricSource):
    """The metrics of one scrape."""

    def __init__(self, service: BundleService) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        service = self._service
        robots = GaugeMetricFamily(
            "rosrv_fleet_robots", "robots of a group by condition", labels=["site", "group", "condition"]
        )
        state = GaugeMetricFamily(
            "rosrv_fleet_rollout",
            "1 for the state of a group's last rollout",
            labels=["site", "group", "state"],
        )
        for group in sorted({*service.rollouts, *service.robots}):
            found = group_state(service, group)
            for kind, count in found["conditions"].items():
                robots.add_metric([*group, kind], count)
            if found["rollout"] is not None:
                for one in _STATES:
                    state.add_metric([*group, one], found["rollout"]["state"] == one)
        yield from (robots, state)
        yield GaugeMetricFamily(
            "rosrv_fleet_rollouts_up", "1 while bundles are published and rollouts advance",
            service.advancing and not service.trouble,
        )  # fmt: skip
        if service.publication is not None:
            left = service.publication.expires.timestamp() - clock.wall()
            yield GaugeMetricFamily(
                "rosrv_fleet_metadata_expiry_seconds", "until the signed metadata expire", left
            )
