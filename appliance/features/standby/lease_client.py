"""Control's end of the link to the lease, on one of two appliances."""

import asyncio
import contextlib
from collections.abc import Callable

from appliance.base import clock
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.link import Link
from appliance.control.errors import UnavailableError
from appliance.features.standby import lease_link
from appliance.features.standby.witness.protocol import EXPIRY

_HAND_OVER_SECONDS = 5.0
_SERVES_SECONDS = 0.5


class HandOverError(UnavailableError):
    """The other appliance cannot take over now; the message has the reason."""


class LeaseClient:
    """Control's view of the lease: the last report, and orders to the process `lease`."""

    def __init__(self) -> None:
        self.state: lease_link.LeaseState | None = None
        self._listeners: list[Callable[[lease_link.LeaseState], None]] = []
        self._present: lease_link.ControlPresent | None = None
        self._link = Link(self.heard, self._lost)
        self._news = asyncio.Event()
        self._handing_over: asyncio.Future[str] | None = None

    def attach(self, channel: Channel) -> None:
        self._link.attach(channel)
        if self._present is not None:
            self.send(self._present)

    def present(self, *, able: bool = True) -> None:
        self._present = lease_link.ControlPresent(able)
        self.send(self._present)

    def withdraw(self) -> None:
        if self._present is not None:
            self._present = None
            self.send(lease_link.ControlUnready())

    async def report_service(self, report: Callable[[], lease_link.ControlServes]) -> None:
        """Report until cancelled: if reports stop, this process does not serve."""
        while True:
            self.send(report())
            await asyncio.sleep(_SERVES_SECONDS)

    def listen(self, changed: Callable[[lease_link.LeaseState], None]) -> None:
        self._listeners.append(changed)
        if self.state is not None:
            changed(self.state)

    def see(self, epoch: int) -> None:
        self.send(lease_link.EpochSeen(epoch))

    def send(self, message: messages.Message) -> None:
        """Without a link the message is lost; the next link begins with a new report."""
        self._link.send(message)

    def active(self) -> bool:
        return self.state is not None and clock.since_boot() < self.state.until

    async def standby_hears_witness(self) -> bool:
        asked = clock.since_boot()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(EXPIRY):
                while self.state is None or (self.state.other_witnessed or 0.0) < asked:
                    self._news.clear()
                    await self._news.wait()
                return True
        return False

    async def until_active(self) -> None:
        """Wait until this appliance may answer. If the lease has ended, the supervisor ends this process."""
        while not self.active():
            self._news.clear()
            await self._news.wait()

    async def hand_over(self) -> None:
        if self._handing_over is not None:
            raise HandOverError("a switchover has already begun: wait for it (rosrv standby status)")
        self._handing_over = asyncio.get_running_loop().create_future()
        try:
            self.send(lease_link.HandOverWanted())
            async with asyncio.timeout(_HAND_OVER_SECONDS):
                reason = await self._handing_over
        except TimeoutError:
            raise HandOverError("the process `lease` does not answer; check the log, and try again") from None
        finally:
            self._handing_over = None
        if reason:
            raise HandOverError(reason)

    def heard(self, message: object) -> None:
        match message:
            case lease_link.LeaseState():
                self.state = message
                self._news.set()
                for changed in self._listeners:
                    changed(message)
            case lease_link.HandOverAnswered(reason):
                if self._handing_over is not None and not self._handing_over.done():
                    self._handing_over.set_result(reason)

    def _lost(self, _reason: str) -> None:
        """Keep the last report: its `until` ends the right to answer."""
