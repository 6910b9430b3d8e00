from datetime import UTC, datetime
from pathlib import Path

from appliance.channel.admin import PolicyLoad
from appliance.control.assembly.host_blocks import BLOCKS, BlockTable
from appliance.control.assembly.policies import Policies, passed_changes
from appliance.policy.judgement import PolicyContext
from appliance.policy.model import Category, Request, address_of
from appliance.policy.policy import CurrentPolicy
from appliance.store.ends import EndTable
from appliance.store.state_file import StateStore
from tests.support.control_parts import OPEN, Records
from tests.support.ends import WALL, Ending, Endings
from tests.unit.store.unconfirmed import unconfirmed

HOST = address_of("10.0.0.66")


def block(store: StateStore, ends: EndTable) -> Ending:
    blocks = BlockTable(store, ends)
    ends.when_due(BLOCKS, lambda _names: blocks.take(HOST))
    return Ending(
        lambda seconds: blocks.put(HOST, seconds=seconds, who="ann", note=""),
        lambda: HOST in blocks.reasons,
    )


async def at_once() -> None: ...


def right(store: StateStore, ends: EndTable) -> Ending:
    """A right with a date. Its author knows the date, even if the machine's clock is not set yet."""

    def known() -> PolicyContext:
        return PolicyContext(now=ends.system_time(), ends=passed_changes(ends))

    policies = Policies(
        Path("policy.ini"), store, ends, Records(), CurrentPolicy(),
        known=known, live=list, changed=lambda _before, _policy: 0, carried_out=at_once,
    )  # fmt: skip
    if store.revisions(1):
        policies.start(restarted=True)

    def begin(seconds: float) -> object:
        until = datetime.fromtimestamp((ends.system_time() or WALL - 600.0) + seconds, UTC)
        line = f"/x = {HOST} until {until:%Y-%m-%dT%H:%M:%S}"
        return policies.load(PolicyLoad(OPEN.replace("[Publishers]", f"[Publishers]\n{line}")), "ann")

    def lasts() -> bool:
        policies.time_passed()  # `ClockCheck` calls it after each step of the clock
        request = Request(HOST, "/n", Category.PUBLISH, "/x")
        return bool(policies.policy) and policies.current.decide(request).allowed

    return Ending(begin, lasts)


ENDINGS: Endings = {
    Policies.changes: right,  # before `unconfirmed`, of whose kind it is the owner in control
    BLOCKS: block,
    Policies.unconfirmed: unconfirmed(Policies.unconfirmed),
}
