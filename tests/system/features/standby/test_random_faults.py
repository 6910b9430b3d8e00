"""Random faults of the pair, new ones each night, so that each link, process, disk and order has its turn."""

import datetime

from benchmarks.pair_fault_kinds import drawn
from benchmarks.pair_faults import QUIET_SECONDS, run
from tests.support.nodes import need_ros
from tests.support.requirements import need_program, need_root
from tests.support.waiting import allowed

_FAULTS = 20


def test_random_faults_break_no_promise() -> None:
    """To repeat a failure: `python -m benchmarks.pair_faults --faults 20 --seed NUMBER`, as in the message."""
    need_root()
    need_program("nft", "nftables")
    need_ros()
    seed = datetime.datetime.now(tz=datetime.UTC).toordinal()
    broken = [
        (seed, row.number, row.fault, row.broken, row.story)
        for row in run(drawn(_FAULTS, seed), done=0, load=0, limit=allowed(QUIET_SECONDS))
        if row.broken
    ]
    assert not broken
