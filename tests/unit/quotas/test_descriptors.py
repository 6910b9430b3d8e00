import resource
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.configuration.settings import LimitsSection, Settings
from appliance.master.calls.gate import HostLimits
from appliance.quotas.descriptors import connections_within
from appliance.quotas.table import (
    DESCRIPTORS,
    NODE_PORTS,
    RELAY_CONNECTIONS,
    RELAY_MESSAGE,
    REST_CONNECTIONS,
    RVMASTER_CONNECTIONS,
    RVMASTER_FAREWELLS,
)
from appliance.relay.process import descriptors_for
from appliance.supervisor.roles import ROLES

BESIDE = 1024  # databases, links, listeners, calls to rosmaster, threads
TRUE = Path("/bin/true")


def test_all_quotas_together_fit_the_descriptors() -> None:
    files = {role.name: role.files for role in ROLES}
    ports = NODE_PORTS.bounds.whole
    nodes = ports // 2  # with one relay, which gives the most nodes
    connections = RVMASTER_CONNECTIONS.bounds.whole + RVMASTER_FAREWELLS.bounds.whole
    assert (
        connections + ports + 3 * nodes + BESIDE <= files["control"]
    )  # a proxy endpoint has a duplicate and a second socket
    assert connections <= files["control"] // 2
    assert descriptors_for(RELAY_CONNECTIONS.bounds.whole) + nodes <= files["relay"]
    assert 2 * REST_CONNECTIONS.bounds.whole + BESIDE <= files["api"]
    assert files["control"] == files["relay"] == DESCRIPTORS.bounds.whole == 16 * files["api"]


def test_the_configuration_has_the_tables_bounds() -> None:
    settings = Settings()
    for given, row in (
        (settings.limits, RVMASTER_CONNECTIONS),
        (settings.relay, RELAY_CONNECTIONS),
        (settings.api_limits, REST_CONNECTIONS),
    ):
        assert (given.connections, given.connections_per_host) == (row.bounds.whole, row.bounds.host)
    assert LimitsSection().topics_per_host == HostLimits().registrations
    assert 1000 * settings.relay.budget == RELAY_MESSAGE.bounds.host


@pytest.fixture
def few_descriptors() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (1000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_where_the_system_allows_fewer_connections_have_half(few_descriptors: None) -> None:
    assert [connections_within(wanted) for wanted in (100, 4096)] == [100, 500]
