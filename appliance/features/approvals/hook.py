"""Control's end of the link to the process `hook`: passes calls on, and counts unsent ones."""

import msgspec

from appliance.base import clock
from appliance.channel.channel import ChannelFullError
from appliance.channel.link import Link
from appliance.features.approvals.approval_table import ApprovalEntry
from appliance.features.approvals.hook_link import CallSent, CallWaits
from appliance.features.approvals.view import ApprovalCounts

UNSENT_SECONDS = 600.0


class WebHook:
    """Passes on each call that begins to wait; `wanted` is whether a web hook is configured."""

    def __init__(self, *, wanted: bool) -> None:
        self.wanted = wanted
        self.link = Link(self.heard)
        self._unsent: list[float] = []
        self._trouble = ""

    def notify(self, entry: ApprovalEntry, seconds: float) -> None:
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
        if isinstance(message, CallSent) and message.trouble:
            self._failed(message.trouble)
        elif isinstance(message, CallSent):
            self._unsent.clear()

    def _failed(self, trouble: str) -> None:
        self._unsent.append(clock.now())
        self._trouble = trouble

    def unsent(self) -> tuple[int, str]:
        """Return the number of unsent calls in the last ten minutes, or since the last sent one, and the reason."""
        self._unsent = [at for at in self._unsent if clock.now() - at < UNSENT_SECONDS]
        return len(self._unsent), self._trouble if self._unsent else ""


def with_hook(counts: ApprovalCounts, hook: WebHook) -> ApprovalCounts:
    number, why = hook.unsent()
    return msgspec.structs.replace(counts, unsent=number, unsent_why=why)
