"""Note who uses REST and the console from which host, for the answer to a block (`HostUses`)."""

from collections import OrderedDict
from collections.abc import Callable, Iterable

from appliance.base import clock
from appliance.base.counted import counted
from appliance.channel.messages.api import LongRequest
from appliance.policy.host_sets import canonical_address
from appliance.policy.model import Address, address_of

_RECENT_SECONDS = 900.0
_MOST_RECENT = 1000


class RestUses:
    """The people and programs that lately used REST and the console, and the requests that still run.

    `blocked()` returns the hosts that REST must refuse.
    """

    def __init__(self, blocked: Callable[[], Iterable[Address]] = tuple) -> None:
        self.blocked = blocked
        self._recent: OrderedDict[tuple[Address, str], float] = OrderedDict()  # oldest first
        self._running: list[LongRequest] = []

    def called(self, host: str, who: str) -> None:
        key = _address(host), who
        if key[0] is None or not who:
            return
        self._recent[key[0], who] = clock.now()
        self._recent.move_to_end((key[0], who))
        while len(self._recent) > _MOST_RECENT:
            self._recent.popitem(last=False)

    def running(self, requests: list[LongRequest]) -> None:
        self._running = requests

    def of(self, host: Address) -> Iterable[str]:
        now = clock.now()
        for (address, who), at in self._recent.items():
            if address == host and now - at < _RECENT_SECONDS:
                yield f"session of {who} (REST, last call {now - at:.0f} s ago)"
        for one in self._running:
            if _address(one.host) == host:
                yield f"{counted(one.count, 'follower')} of {one.who} ({one.path})"


def _address(text: str) -> Address | None:
    try:
        return canonical_address(address_of(text))
    except ValueError:
        return None
