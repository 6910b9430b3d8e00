from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

import pytest

from appliance.channel.messages import Message, UpstreamWanted
from appliance.relay.connections.relayed_topic import RelayedTopic
from appliance.relay.connections.upstream import PublisherConnection, UpstreamState
from appliance.relay.context import RelayContext
from appliance.relay.relay_limits import RelayLimits


@dataclass
class Timer:
    seconds: float
    callback: Callable[[], None]

    def cancel(self) -> None:
        """Do nothing: the test calls what it wants."""


@dataclass
class Relay:
    unsettled: bool
    topic = "/chatter"
    key = "k"
    host = "10.0.0.2"
    limits = RelayLimits()
    timers: list[Timer] = field(default_factory=list)
    sent: list[Message] = field(default_factory=list)

    @property
    def loop(self) -> "Relay":
        return self

    @property
    def reporter(self) -> "Relay":
        return self

    def after(self, seconds: float, callback: Callable[[], None]) -> Timer:
        self.timers.append(Timer(seconds, callback))
        return self.timers[-1]

    def send(self, message: Message) -> None:
        self.sent.append(message)


@pytest.mark.parametrize(("unsettled", "seconds"), [(False, 0.0), (True, RelayLimits().linger)])
def test_a_lazy_publisher_learns_at_once_that_it_has_no_subscriber(unsettled: bool, seconds: float) -> None:
    relay = Relay(unsettled)
    publisher = PublisherConnection(
        cast(RelayContext, relay),
        cast(RelayedTopic, relay),
    )
    publisher.connect()
    publisher.release()
    assert relay.timers[-1].seconds == seconds
    relay.timers[-1].callback()
    assert publisher.state is UpstreamState.IDLE
    publisher.connect()
    assert relay.sent == [UpstreamWanted("k", "/chatter")] * 2
