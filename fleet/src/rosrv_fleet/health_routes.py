"""Health over REST, and metrics in Prometheus's format."""

from collections.abc import Iterator

import msgspec
from fastapi import APIRouter, Depends, Response
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector as MetricSource

from appliance.base import clock
from rosrv_fleet.access import holder_of
from rosrv_fleet.collector import Collector
from rosrv_fleet.health import FleetHealth, health_of
from rosrv_fleet.rollouts.operator_routes import group_state
from rosrv_fleet.rollouts.service import BundleService
from rosrv_fleet.tokens import FleetRole

_ROLLOUT_STATES = ("running", "stopped", "reverted", "done")


def health_router(collector: Collector) -> APIRouter:
    router = APIRouter()
    viewer = [Depends(holder_of(collector.tokens, FleetRole.VIEWER))]

    @router.get("/healthz")
    async def alive() -> dict[str, bool]:
        """Answer 200 while the collector runs; load balancers need no token."""
        return {"ok": True}

    @router.get("/v1/health", dependencies=viewer)
    def health() -> Response:
        """Return the state of the robots, the store and the index."""
        return Response(msgspec.json.encode(health_of(collector)), media_type="application/json")

    @router.get("/metrics", dependencies=viewer)
    def metrics() -> Response:
        """Return the state of `/v1/health` as Prometheus metrics."""
        registry = CollectorRegistry()
        registry.register(RobotMetrics(health_of(collector)))
        if collector.bundles is not None:
            registry.register(_RolloutMetrics(collector.bundles))
        return Response(generate_latest(registry), media_type="text/plain; version=0.0.4; charset=utf-8")

    return router


class RobotMetrics(MetricSource):
    """The metrics of robots for one scrape."""

    def __init__(self, health: FleetHealth) -> None:
        self._health = health

    def collect(self) -> Iterator[Metric]:
        def gauge(name: str, help_text: str) -> GaugeMetricFamily:
            return GaugeMetricFamily(f"rosrv_fleet_{name}", help_text, labels=["robot"])

        health = self._health
        age = gauge("segment_age_seconds", "seconds since the robot's newest segment arrived")
        ends = gauge("certificate_seconds", "seconds until the robot's certificate ends")
        silent = gauge("robot_silent", "1 while an appliance of the robot was not heard for silent_seconds")
        off = gauge("robot_off", "1 while an appliance of the robot is shut down cleanly, and none is silent")
        heard = GaugeMetricFamily(
            "rosrv_fleet_heard_seconds",
            "seconds since an appliance pushed a segment or stated that nothing waits",
            labels=["robot", "appliance"],
        )
        gaps = gauge("gaps", "places where segments of the robot are missing")
        forks = gauge("forks", "segments of the robot with a number that another one has")
        for robot in health.robots:
            if robot.age_seconds is not None:
                age.add_metric([robot.name], robot.age_seconds)
            ends.add_metric([robot.name], robot.certificate_seconds)
            silent.add_metric([robot.name], robot.silent)
            off.add_metric([robot.name], robot.off)
            for appliance, seconds in robot.heard_seconds.items():
                if seconds is not None:
                    heard.add_metric([robot.name, appliance], seconds)
            gaps.add_metric([robot.name], robot.gaps)
            forks.add_metric([robot.name], robot.forks)
        yield from (age, ends, silent, off, heard, gaps, forks)
        yield GaugeMetricFamily(
            "rosrv_fleet_waiting", "stored segments that the index does not have", health.waiting
        )
        yield GaugeMetricFamily(
            "rosrv_fleet_index_up", "1 while segments are indexed", health.trouble is None
        )
        yield GaugeMetricFamily(
            "rosrv_fleet_disk_up", "1 while there is room for segments", health.disk is None
        )


class _RolloutMetrics(MetricSource):
    """The metrics of rollouts by group. No label has a robot's text, so robots cannot fill Prometheus."""

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
                for one in _ROLLOUT_STATES:
                    state.add_metric([*group, one], found["rollout"]["state"] == one)
        yield from (robots, state)
        yield GaugeMetricFamily(
            "rosrv_fleet_rollouts_up", "1 while bundles are published and rollouts advance",
            service.advancing and not service.publisher.trouble,
        )  # fmt: skip
        if (expires := service.publisher.expires) is not None:
            left = expires - clock.wall()
            yield GaugeMetricFamily(
                "rosrv_fleet_metadata_expiry_seconds", "until the signed metadata expire", left
            )
