"""Tests of `appliance.forwarding.process`: what every control learns of what was missed."""

import asyncio
from collections.abc import Callable
from typing import Any, cast

import pytest

from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.configuration.settings import Syslog
from appliance.control.forwarder_link import Forwarded
from appliance.forwarding.process import Reports
from appliance.telemetry.audit_trail import AuditTrail


class Control:
    """A control, as far as it hears the forwarder; `gaps` is what it recorded."""

    def __init__(self) -> None:
        self.gaps: list[int] = []
        self.forwarded = Forwarded(Syslog(to="udp://127.0.0.1:514"), cast(AuditTrail, self))
        self.hears: Callable[[object, tuple[int, ...]], None] = lambda _message, _descriptors: None

    def happened(self, event: str, _text: str, **detail: Any) -> None:
        """As the trail takes it."""
        if event == "forwarding gap":
            self.gaps.append(detail["count"])

    def attach(self, _loop: object, received: Any, *_ends: object) -> None:
        """As a channel takes it."""
        self.hears = received

    def close(self) -> None:
        """As a channel does it."""


def missed(count: int) -> messages.ForwardingReported:
    """So many records were missed."""
    return messages.ForwardingReported(missed=count)


@pytest.fixture
def controls() -> list[Control]:
    """The controls that were there, the one that is there now last; none at first."""
    return []


@pytest.fixture
def reports(controls: list[Control]) -> Reports:
    """Reports to the control that is there."""

    def send(message: messages.ForwardingReported) -> bool:
        if controls:
            controls[-1].hears(message, ())
        return bool(controls)

    return Reports(send)


def begin(controls: list[Control], reports: Reports, progress: messages.ForwardingReported) -> Control:
    """A control that is there from now on."""
    control = Control()
    control.forwarded.link.attach(cast(Channel, control))
    controls.append(control)
    reports.anew(progress)
    return control


def test_what_was_missed_before_the_first_link(controls: list[Control], reports: Reports) -> None:
    """A forwarder that missed records before control was there has that recorded."""

    async def play() -> None:
        reports.tell(missed(3))
        control = begin(controls, reports, missed(7))
        assert control.gaps == [7]
        reports.tell(missed(9))
        assert control.gaps == [7, 2]
        status = control.forwarded.status()
        assert status is not None
        assert status.missed == 9

    asyncio.run(play())


def test_what_was_missed_between_two_controls(controls: list[Control], reports: Reports) -> None:
    """What one control recorded the next does not record again; what came in between, it does."""

    async def play() -> None:
        begin(controls, reports, missed(0))
        reports.tell(missed(5))
        gone = controls.pop()
        reports.tell(missed(8))
        assert gone.gaps == [5]
        assert begin(controls, reports, missed(8)).gaps == [3]
        assert begin(controls, reports, missed(8)).gaps == []

    asyncio.run(play())
