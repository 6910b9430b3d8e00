from ipaddress import ip_network
from pathlib import Path

import pytest

from appliance.channel.answers.limit_answers import LimitUse
from appliance.configuration.config_sources import read
from appliance.control.operators.limit_use import OwnUses
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.registry import Kind, Registry
from appliance.policy.host_sets import Network
from appliance.policy.model import Address
from appliance.quotas.pool import Bounds, Pool, QuotaClass
from appliance.quotas.table import NODES, QUOTA_ROWS
from tests.support.core import FakeTrail
from tests.support.incarnations import incarnation


def used(state: Path, memory: dict[int, dict[str, int]]) -> dict[str, LimitUse]:
    bounds = Bounds(100, 75, 10, 0)
    ports: Pool[Network] = Pool("ports", bounds, lambda _host: QuotaClass.REGISTERED)
    pool: Pool[Address] = Pool("bytes", bounds, lambda _host: QuotaClass.REGISTERED)
    ports.charge(ip_network("10.0.0.9/32"), 40)
    ports.charge(ip_network("10.0.0.8/32"), 2)
    registry = Registry()
    for number, host in enumerate(("10.0.0.9", "10.0.0.9", "10.0.0.8", "127.0.0.1")):
        registry.add(incarnation(f"/node{number}", 4000 + number, host=host))
    *_others, own = registry.all()
    own.own = True
    for number in range(7):
        registry.register(registry.all()[0], Kind.PUBLICATION, f"/t{number}", "std_msgs/String")
    carried = RelayTraffic(FakeTrail(), registry, 2, lambda _node, _topic: None)
    carried.memory = memory
    settings = read({"state": str(state), "audit": {"retention_bytes": 4 << 20}, "relays": 2})
    uses = OwnUses(registry, carried, lambda: ports, pool, pool, settings)
    return {row.resource: row for row in uses()}


def test_each_resource_has_its_use_and_the_host_with_most(tmp_path: Path) -> None:
    (tmp_path / "control").mkdir()
    (tmp_path / "control" / "audit.db").write_bytes(bytes(1000))
    (tmp_path / "control" / "audit.db-wal").write_bytes(bytes(24))
    rows = used(tmp_path, {0: {"frames": 5}, 1: {"frames": 9, "queues": 1}})
    assert rows["nodes"] == LimitUse("nodes", 3, None, "limits.nodes_per_host", "10.0.0.9", 2, 500)
    assert rows["ports of nodes"] == LimitUse("ports of nodes", 42, 100, "[Ports] range", "10.0.0.9", 40, 75)
    assert (rows["registrations"].used, rows["registrations"].host_used) == (7, 7)
    assert rows["connections to the relays"].allowed == 2 * 16_384
    fullest = rows["bytes of unfinished messages, one relay"]
    assert (fullest.used, fullest.allowed) == (9, 512 << 20)
    records = rows["bytes of audit records"]
    assert (records.used, records.allowed) == (1024, 4 << 20)


def test_the_page_of_quotas_has_each_limit_that_is_shown(tmp_path: Path) -> None:
    (tmp_path / "control").mkdir()
    rows = used(tmp_path, {})
    assert rows["nodes"].host_allowed == NODES.bounds.host
    on_page = [row.setting.partition(" (")[0] for row in QUOTA_ROWS]
    assert {row.setting for row in rows.values()} - {*on_page} == {"audit.retention_bytes, or the disk"}


def test_a_log_file_that_ends_while_it_is_measured_has_no_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "control"
    folder.mkdir()
    (folder / "audit.db").write_bytes(bytes(1000))
    monkeypatch.setattr(Path, "glob", lambda *_names: iter([folder / "audit.db", folder / "audit.db-wal"]))
    assert used(tmp_path, {})["bytes of audit records"].used == 1000


def test_without_retention_the_disk_is_the_limit(tmp_path: Path) -> None:
    (tmp_path / "control").mkdir()
    queries = used(tmp_path, {})
    assert queries["bytes of latched messages, one relay"].used == 0
