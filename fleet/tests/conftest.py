"""Tests that need the extra `signing`, which brings the appliance, are skipped without it, with the reason."""

from collections.abc import Iterator
from importlib.metadata import distributions
from pathlib import Path

import pytest
from hypothesis import settings

from tests.support.examples import examples

# The time of an example depends on the load of the machine.
settings.register_profile("no clock", deadline=None, max_examples=examples(100))
settings.load_profile("no clock")

_SIGNS = any(distribution.name == "rosrv-appliance" for distribution in distributions())
_REASON = "needs the appliance: pip install 'rosrv-fleet[signing]', or the environment of `make setup`"


class _Skipped(pytest.Collector):
    def collect(self) -> Iterator[pytest.Item]:
        pytest.skip(_REASON)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "signing: needs the extra `signing`")


def pytest_collect_directory(path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Skip `system`: the robots there send with the appliance's own code."""
    if path.name == "system" and not _SIGNS:
        return _Skipped.from_parent(parent, name=path.name)
    return None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if not _SIGNS and item.get_closest_marker("signing"):
            item.add_marker(pytest.mark.skip(_REASON))
