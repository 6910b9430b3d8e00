import json
import time
from functools import partial

import pytest

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
