"""Define a metric of `/metrics`."""

from typing import Literal, NamedTuple

BOUNDS = (0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0)  # seconds


class Metric(NamedTuple):
    """A metric; `name` is its name in Prometheus."""

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    labels: tuple[str, ...]
    help: str
    bounds: tuple[float, ...] = BOUNDS
    """The upper bounds of a histogram, in seconds."""


def counter(name: str, help: str, *labels: str) -> Metric:  # noqa: A002  as Prometheus's own client calls it
    return Metric(name, "counter", labels, help)


def gauge(name: str, help: str, *labels: str) -> Metric:  # noqa: A002  as above
    return Metric(name, "gauge", labels, help)


def histogram(name: str, help: str, *labels: str, bounds: tuple[float, ...] = BOUNDS) -> Metric:  # noqa: A002  as above
    return Metric(name, "histogram", labels, help, bounds)
