"""Execute jobs as tasks of a Ray cluster, whose nodes have this package installed.

Ray's token authentication is on unless the environment switches it off (`RAY_AUTH_MODE`).
"""

import logging
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from rosmop.batch.executor import Work, WorkerDeath

ADDRESSES = "ray://HEAD:PORT, or auto on a node of the cluster"
_AHEAD = 2  # jobs for each processor, so that none waits for the next job


class ClusterError(Exception):
    """The cluster cannot be used."""


class RayCluster:
    """The processors of a cluster. Raises `ClusterError`."""

    def __init__(self, work: Work, address: str) -> None:
        if address.removeprefix("ray:") != "auto" and not address.startswith("ray://"):
            raise ClusterError(f"{address!r} is not a cluster: give {ADDRESSES}")
        os.environ.setdefault("RAY_AUTH_MODE", "token")
        try:
            import ray  # noqa: PLC0415  an optional extra, which takes seconds to load
        except ImportError:
            raise ClusterError("Ray is not installed: pip install 'rosmop[ray]'") from None
        self._ray: Any = ray
        # Ray prints errors of nodes to standard output, which has the results; it has no option for this.
        self._ray._private.worker.print_to_stdstream = _print_to_stderr
        try:
            ray.init(
                address if address.startswith("ray://") else "auto",
                logging_level=logging.ERROR,
                log_to_driver=False,
            )
            processors = int(self._ray.cluster_resources().get("CPU", 0))
        except Exception as error:
            ray.shutdown()
            raise ClusterError(f"cannot use the cluster {address}: {_reason(error)}") from error
        self.capacity = max(processors, 1) * _AHEAD
        # `execute` tries again, as on one machine.
        self._task = ray.remote(num_cpus=1, max_retries=0)(work)
        self._running: dict[object, int] = {}

    def submit(self, number: int, job: bytes) -> None:
        with _reached():
            self._running[self._task.remote(job)] = number

    def collect(self) -> list[tuple[int, bytes | WorkerDeath]]:
        with _reached():
            (ready,), _others = self._ray.wait(list(self._running), num_returns=1)
            number = self._running.pop(ready)
            try:
                return [(number, self._ray.get(ready))]
            except self._ray.exceptions.RayError as error:
                return [(number, WorkerDeath(f"its worker in the cluster failed: {_reason(error)}"))]

    def close(self) -> None:
        with suppress(Exception):  # whatever failed was reported, and all results are here
            self._ray.shutdown()


@contextmanager
def _reached() -> Iterator[None]:
    """Turn any error of Ray's client, whose types are not documented, into a `ClusterError`."""
    try:
        yield
    except Exception as error:
        raise ClusterError(f"the cluster cannot be reached any more: {_reason(error)}") from error


def _print_to_stderr(data: Mapping[str, Any], **_options: object) -> None:
    sys.stderr.writelines(f"ray: {line!a}\n" for line in data["lines"])


def _reason(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if "Traceback (most recent call last):" in lines:
        lines = [lines[0], lines[-1]]
    said = " ".join(lines[:2] if lines and lines[0].endswith(":") else lines[:1])
    return f"{type(error).__name__}: {said}" if said else type(error).__name__
