"""Control's end of the link to the process `hook`: tells it of calls, and counts those that it could not tell."""

from appliance.base import clock
from appliance.channel.channel import ChannelFullError
from appliance.channel.link import Link
from appliance.features.approvals.approval_table import ApprovalEntry
from appliance.features.approvals.hook_link import CallTold, CallWaits

UNTOLD_SECONDS = 600.0


class Hook:
    """Tells of each call that begins to wait; `wanted` is whether a web hook is configured."""

    def __init__(self, *, wanted: bool) -> None:
        self.wanted = wanted
        self.link = Link(self.heard)
        self._untold: list[float] = []
        self._trouble = ""

    def tell(self, entry: ApprovalEntry, seconds: float) -> None:
        """Tell it at once; nothing here waits, and a failure changes nothing for the call."""
        if not self.wanted:
            return
        call = entry.call
        message = CallWaits(
            entry.number, str(call.host), entry.caller_id, call.category.value, call.resource, entry.type,
            seconds,
        )  # fmt: skip
        try:
            if not self.link.send(message):
                self._failed("its process is not running")
        except ChannelFullError:
            self.link.close()
            self._failed("its process does not read")

    def heard(self, message: object) -> None:
        if isinstance(message, CallTold) and message.trouble:
            self._failed(message.trouble)
        elif isinstance(message, CallTold):
            self._untold.clear()

    def _failed(self, trouble: str) -> None:
        self._untold.append(clock.now())
        self._trouble = trouble

    def untold(self) -> tuple[int, str]:
        """Return how many calls were not told in the last ten minutes, or since the last one that was; and why."""
        self._untold = [at for at in self._untold if clock.now() - at < UNTOLD_SECONDS]
        return len(self._untold), self._trouble if self._untold else ""
