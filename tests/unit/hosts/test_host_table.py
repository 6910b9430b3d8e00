import ipaddress
from collections.abc import Callable
from itertools import count
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.channel.messages import CertificateMade
from appliance.hosts.host_table import HostTable
from appliance.hosts.hosts_file import DeclaredHosts
from appliance.store.changes import Change
from appliance.store.state_file import StateStore
from tests.support.engines import InlineDatabase, KilledError
from tests.support.virtual_clock import VirtualClock

DAY = 86_400.0


def opened(home: Path) -> tuple[StateStore, HostTable]:
    store = StateStore(home, failed=pytest.fail, kind=InlineDatabase)
    return store, HostTable(store, ipaddress.IPv4Network("10.113.0.0/24"), DeclaredHosts(home / "hosts.yaml"))


def made(serial: str) -> CertificateMade:
    return CertificateMade(1, b"certificate", serial, clock.wall() + 30 * DAY)


def die_after(store: StateStore, writes: int) -> None:
    left, keep = iter(range(writes)), store.database.keep

    def keep_some(changes: list[tuple[Change, bool]]) -> None:
        if next(left, None) is None:
            raise KilledError
        keep(changes)

    store.database.keep = keep_some  # type: ignore[method-assign]  # only some writes reach the disk


@pytest.mark.parametrize(
    "late", [0.0, 25 * DAY, 60 * DAY, -400 * DAY], ids=lambda late: f"{late / DAY:.0f} days"
)
def test_a_late_confirmation_shortens_no_life(late: float, tmp_path: Path) -> None:
    """The next certificate gets the life of the present one, whatever the clock does in between."""
    store, table = opened(tmp_path)
    with clock.using(machine := VirtualClock()):
        table.keep("ocu", "10.113.0.2", made("a1"))
        for serial in ("b2", "c3"):
            table.keep_next("ocu", made(serial))
            machine.set_wall(clock.wall() + late)
            assert table.take_next("ocu") is not None
            assert table.rows["ocu"].expires - table.certificates["ocu"].made == pytest.approx(30 * DAY)
    store.close()


@pytest.mark.parametrize(
    "change",
    [
        lambda table: table.keep("ocu", "10.113.0.2", made("c3")),
        lambda table: table.keep_next("ocu", made("c3")),
        lambda table: table.take_next("ocu"),
    ],
    ids=["keep", "keep_next", "take_next"],
)
def test_a_host_keeps_a_certificate_whenever_control_dies(
    change: Callable[[HostTable], object], tmp_path: Path
) -> None:
    for writes in count():
        (home := tmp_path / str(writes)).mkdir()
        store, table = opened(home)
        table.keep("ocu", "10.113.0.2", made("a1"))
        table.keep_next("ocu", made("b2"))
        die_after(store, writes)
        try:
            change(table)
            killed = False
        except KilledError:
            killed = True
        store.close()
        again, table = opened(home)
        revoked = {row.serial for row in table.listed_as_revoked()}
        assert table.rows["ocu"].serial not in revoked, f"after {writes} writes"
        again.close()
        if not killed:
            break
