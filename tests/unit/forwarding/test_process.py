import asyncio
import socket
import threading

import pytest

from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.control.links.forwarder_link import ForwarderLink
from appliance.forwarding.process import ForwardingProcess, ProgressReports
from tests.support.core import FakeTrail
from tests.support.memory_channel import HeldChannel

pytestmark = pytest.mark.anyio


class Control:
    """A control on a link to the forwarder."""

    def __init__(self) -> None:
        self.trail, self.channel = FakeTrail(), HeldChannel()
        self.forwarded = ForwarderLink("udp://127.0.0.1:514", "all", self.trail)
        self.forwarded.link.attach(self.channel)

    @property
    def gaps(self) -> list[int]:
        return [row["count"] for row in self.trail.rows if row["event"] == "forwarding gap"]


def missed(count: int) -> messages.ForwardingReported:
    return messages.ForwardingReported(missed=count)


@pytest.fixture
def controls() -> list[Control]:
    return []


@pytest.fixture
def reports(controls: list[Control]) -> ProgressReports:
    def send(message: messages.ForwardingReported) -> bool:
        if controls:
            controls[-1].channel.say(message)
        return bool(controls)

    return ProgressReports(send)


def begin(
    controls: list[Control], reports: ProgressReports, progress: messages.ForwardingReported
) -> Control:
    control = Control()
    controls.append(control)
    reports.anew(progress)
    return control


class SlowForwarder:
    """A forwarder whose receiver answers the last report late."""

    progress = messages.ForwardingReported()

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self.answered: list[bool] = []

    def step(self) -> float:
        return 60.0

    def close(self, *, stopped: bool = False) -> None:
        threading.Event().wait(self._seconds)
        self.answered.append(stopped)


@pytest.mark.nightly
async def test_the_last_report_has_the_time_that_the_supervisor_gives() -> None:
    far, near = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    supervisor = Channel(far, messages.Lifeline)
    supervisor.attach(asyncio.get_running_loop(), lambda _message, _descriptors: None, lambda: None)
    forwarder = SlowForwarder(1.5)
    supervisor.send(messages.Stop())
    await ForwardingProcess(forwarder, near.detach()).run()
    assert forwarder.answered == [True]
    supervisor.close()


async def test_records_missed_before_the_first_link_are_reported(
    controls: list[Control], reports: ProgressReports
) -> None:
    reports.tell(missed(3))
    control = begin(controls, reports, missed(7))
    assert control.gaps == [7]
    reports.tell(missed(9))
    assert control.gaps == [7, 2]
    status = control.forwarded.status()
    assert status is not None
    assert status.missed == 9


async def test_records_missed_between_two_controls_are_reported(
    controls: list[Control], reports: ProgressReports
) -> None:
    begin(controls, reports, missed(0))
    reports.tell(missed(5))
    gone = controls.pop()
    reports.tell(missed(8))
    assert gone.gaps == [5]
    assert begin(controls, reports, missed(8)).gaps == [3]
    assert begin(controls, reports, missed(8)).gaps == []
