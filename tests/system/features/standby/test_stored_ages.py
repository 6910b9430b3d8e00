import json
import time
from datetime import UTC, datetime, timedelta
from functools import partial

import pytest

from appliance.channel import admin
from tests.support.appliance import OPEN_POLICY
from tests.support.features.standby.standby_site import OCU, StandbySite
from tests.support.waiting import allowed, eventually

HOUR = 3600.0


def blocked_for(site: StandbySite, name: str) -> float:
    block = json.loads(site.appliances[name].rosrv("host", "blocks", "--json").stdout)
    return float(block["until"]) - time.time()


@pytest.mark.parametrize("ahead", [HOUR, -HOUR])
def test_a_block_keeps_its_length_over_switchovers(site: StandbySite, ahead: float) -> None:
    active, passive = site.pair()
    age = site.appliances[passive].state / "control" / "age"
    now = time.time_ns()
    age.write_text(json.dumps({"lived": 0, "credited": now + int(ahead * 1e9), "believed": now}))
    site.appliances[active].rosrv("host", "block", OCU, "--for", "1h")
    began = time.monotonic()
    for leaves, follows in ((active, passive), (passive, active)):
        time.sleep(6.0)  # noqa: TID251  a reading of the clocks is replicated every five seconds
        site.promote(leaves)
        site.until_taken_over(follows)
        left = eventually(partial(blocked_for, site, follows), site.story)
        assert left == pytest.approx(HOUR - (time.monotonic() - began), abs=allowed(5.0))
        site.until_both_in_sync()
    site.appliances[active].rosrv("host", "unblock", OCU)


def test_a_right_ends_at_its_date_on_the_other_appliance(site: StandbySite) -> None:
    """And a switchover back, with the other's age clock, does not begin it again."""
    active, passive = site.pair()
    end = (datetime.now(UTC) + timedelta(seconds=40.0)).replace(microsecond=0)
    line = f"/shift = {OCU} until {end:%Y-%m-%dT%H:%M:%S}"
    policy = OPEN_POLICY.replace("[Subscribers]", f"{line}\n[Subscribers]", 1)
    site.appliances[active].ask(admin.PolicyLoad(f"{policy}[Options]\ntakeover = granted\n"))

    def granted(name: str) -> bool:
        request = ("--host", OCU, "--node", "/n", "--publish", "/shift")
        return site.appliances[name].rosrv("policy", "explain", *request, check=False).returncode == 0

    assert granted(active)
    site.until_both_in_sync()
    site.promote(active)
    site.until_taken_over(passive)
    eventually(lambda: granted(passive), site.story)
    assert datetime.now(UTC) < end, "the test needs a takeover before the date"
    eventually(lambda: not granted(passive), site.story, seconds=90.0)
    assert abs((datetime.now(UTC) - end).total_seconds()) < allowed(5.0)
    site.until_both_in_sync()
    site.promote(passive)
    site.until_taken_over(active)
    assert not granted(active)
