import contextlib
import signal
from collections.abc import Iterator

import pytest

from examples.landshark.lab import INTERFACE, Host, Lab
from tests.support.processes import LIMIT, Process
from tests.support.requirements import need_root
from tests.support.tunnel_site import LONG, TunnelSite, left_behind, numbers
from tests.support.tunnels import JoinedHost, need_strongswan

SHORT_LIVES = """
connections {
  rosrv {
    rekey_time = 11s
    over_time = 60s
    rand_time = 0
    children {
      ros {
        rekey_time = 4s
        life_time = 60s
        rand_time = 0
      }
    }
  }
}
"""


@pytest.fixture
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TunnelSite]:
    need_root()
    need_strongswan()
    with Lab("rosrv-endure") as lab, TunnelSite(lab, tmp_path_factory.mktemp("endure")) as one:
        yield one


def up_again(joined: JoinedHost, since: int) -> None:
    assert joined.charon is not None
    joined.charon.wait_for(
        lambda event: "CHILD_SA ros" in str(event.get("text")) and "established" in str(event.get("text")),
        since=since,
        timeout=LONG,
    )


def test_a_host_moves(site: TunnelSite) -> None:
    roamer = site.lab.host("roamer", "10.88.0.40/24")
    roamer.namespace.sysctl("net.ipv4.conf.all.promote_secondaries", "1")
    with site.joined(site.kit(), roamer) as joined, site.talking(joined) as (_, listener):
        mark = site.mark
        for command in (["add", "10.88.0.41/24"], ["del", "10.88.0.40/24"]):
            assert roamer.popen(["ip", "addr", *command, "dev", INTERFACE]).wait(LIMIT) == 0
        moved = site.recorded(mark, event="tunnel moved")
        assert (moved["host"], moved["detail"]["remote"]) == (joined.address, "10.88.0.41")
        listener.wait_for_count(len(listener.seen(event="received")) + 20, event="received")
        assert [host["remote"] for host in site.hosts()] == ["10.88.0.41"]
        assert site.trail.seen(event="tunnel down") == []
        heard = numbers(listener)
        assert heard == list(range(heard[0], heard[0] + len(heard))), "messages were lost"


def test_new_keys_under_traffic(site: TunnelSite) -> None:
    with (
        site.joined(site.kit(), settings=SHORT_LIVES) as joined,
        site.talking(joined, rate=100) as (talker, listener),
    ):
        charon = joined.charon
        assert charon is not None
        _told(charon, "inbound CHILD_SA ros{", 4)
        _told(charon, "rekeyed between", 1)
        sent = int(talker.seen(event="sent")[-1]["number"])
        listener.wait_for(data=f"hello {sent}", timeout=LONG)
        heard = numbers(listener)
        assert heard == list(range(heard[0], heard[0] + len(heard)))
        assert site.trail.seen(event="tunnel down") == []


def _told(charon: Process, text: str, count: int) -> None:
    position = 0
    for _ in range(count):
        found = charon.wait_for(lambda event: text in str(event.get("text")), since=position, timeout=LONG)
        position = next(i for i in range(position, len(charon.events)) if charon.events[i] is found) + 1


@contextlib.contextmanager
def restarted(site: TunnelSite, how: int) -> Iterator[None]:
    site.trail.stop()
    assert site.appliance.process is not None
    site.appliance.process.stop(with_signal=how)
    yield
    site.appliance.start()
    site.watch()


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_both_ends_restart(site: TunnelSite, how: int) -> None:
    kit = site.kit()
    host = site.join(kit)
    with host:
        host.wait_until_up()
        # the appliance alone, while its host stays
        assert host.charon is not None
        mark = host.charon.mark()
        with restarted(site, how):
            pass
        up_again(host, mark)
        with site.talking(host):
            pass
        # the host alone, without notice to the appliance
        host.charon.kill()
        host.stop()
        host.start()
        host.wait_until_up()
        # both: the host returns first and gets no answer; then the other way round
        with restarted(site, how):
            host.stop()
            host.start()
        host.wait_until_up()
        with restarted(site, how):
            host.charon.kill()
        host.stop()
        host.start()
        host.wait_until_up()
        with site.talking(host):
            pass
        site.is_up()


def test_a_clean_stop_leaves_nothing(site: TunnelSite) -> None:
    host = site.appliance.host
    assert isinstance(host, Host)
    with site.join(site.kit()) as joined:
        joined.wait_until_up()
        assert set(left_behind(host)) == {"nftables", "routes", "interfaces", "addresses"}, (
            "in force until then"
        )
        assert site.appliance.stop() == 0
        assert left_behind(host) == {}
