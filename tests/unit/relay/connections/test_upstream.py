"""The end of the connection to a publisher that nobody needs."""

from typing import Any, cast
from unittest.mock import MagicMock

import pytest

from appliance.relay.connections.introductions import Introductions
from appliance.relay.connections.upstream import PublisherConnection
from appliance.relay.relay_limits import RelayLimits


@pytest.mark.parametrize(("unsettled", "seconds"), [(False, 0.0), (True, RelayLimits().linger)])
def test_a_publisher_learns_at_once_that_nobody_listens(unsettled: bool, seconds: float) -> None:
    """A lazy node stops its work then; only during a reload or a restart may its subscriber return."""
    context = MagicMock(limits=RelayLimits())
    introductions = Introductions(lambda: (), lambda: "*")
    connection = PublisherConnection(context, cast(Any, MagicMock()), introductions, lambda: unsettled)
    connection.release()
    assert [call.args[0] for call in context.loop.after.call_args_list] == [seconds]
