"""A takeover with a host in a tunnel of the kernel's ESP, in the machine whose clock counts its instructions."""

import re
import time
from functools import partial
from pathlib import Path

from appliance.network import interfaces
from examples.landshark.lab import Host
from tests.support.nodes import RosSession
from tests.support.processes import LIMIT
from tests.support.tunnel_site import numbers
from tests.system.features.standby import test_two_appliances as two

tunnelled = two.tunnelled

MAX_SECONDS = 10.0
LITTLE = 1000  # bytes: more than those of the pings that keep a tunnel


def test_nodes_are_back(tunnelled: two.TunnelledStandbySite, tmp_path: Path) -> None:
    site = tunnelled.site
    active, standby = site.lab.hosts["a"], site.lab.hosts["b"]
    with tunnelled.join(tunnelled.kit("add", "ocu-1")) as joined:
        joined.wait_until_up()
        with RosSession(joined.master, tmp_path, joined) as there, site.ros() as here:
            here.talker("rospy", "/state", "--rate", str(two.RATE))
            there.talker("rospy", "/orders", "--rate", str(two.RATE), name="boss")
            listeners = there.listener("rospy", "/state"), here.listener("rospy", "/orders", name="arm")
            for listener in listeners:
                listener.wait_for_count(two.RATE, event="received", timeout=2 * LIMIT)
            assert max(esp_bytes(active)) > LITTLE
            assert esp_bytes(standby) == []
            before = [numbers(listener)[-1] for listener in listeners]
            began = time.monotonic()
            assert tunnelled.cut() == "a"
            for listener, last in zip(listeners, before, strict=True):
                # Messages that were already on the way at the cut are not the answer.
                listener.wait_for(partial(two.is_later, last + two.RATE // 2), timeout=2 * LIMIT)
            seconds = time.monotonic() - began
            print(f"{seconds:.2f} s until messages arrived in both directions")  # noqa: T201  a figure for the reader of the run
            assert site.holder() == "b"
            assert max(esp_bytes(standby)) > LITTLE
            assert site.appliances["b"].status()["ipsec"]["esp"] == "kernel"
            assert "ipsec0" not in interfaces.links(standby.namespace)
            assert "/boss" in there.run("rosnode", "list").stdout
            for listener in listeners:
                got = numbers(listener)
                assert got == sorted(set(got))
                assert listener.running
    assert seconds < MAX_SECONDS


def esp_bytes(host: Host) -> list[int]:
    shown = two.told(host, "ip", "-s", "xfrm", "state")
    return [int(one) for one in re.findall(r"(\d+)\(bytes\), \d+\(packets\)", shown)]
