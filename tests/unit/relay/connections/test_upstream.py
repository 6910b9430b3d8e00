"""The end of the connection to a publisher that is no longer needed."""

from unittest.mock import MagicMock

import pytest

from appliance.relay.connections.upstream import PublisherConnection
from appliance.relay.relay_limits import RelayLimits


@pytest.mark.parametrize(("unsettled", "seconds"), [(False, 0.0), (True, RelayLimits().linger)])
def test_a_lazy_publisher_learns_at_once_that_its_last_subscriber_left(
    unsettled: bool, seconds: float
) -> None:
    """Its connection stays only during a reload or a restart, and only until its subscriber may have returned."""
    context = MagicMock(limits=RelayLimits())
    publisher = PublisherConnection(
        context,
        MagicMock(),
        claims=lambda: (),
        registered_type=lambda: "*",
        unsettled=lambda: unsettled,
    )
    publisher.connect()
    context.loop.after.reset_mock()
    publisher.release()
    [(wait, close)] = [call.args for call in context.loop.after.call_args_list]
    assert wait == seconds
    asking = context.reporter.send.call_count
    close()
    context.loop.after.reset_mock()
    publisher.connect()
    assert context.reporter.send.call_count == asking + 1, (
        "it was closed, so the publisher is asked for again"
    )
