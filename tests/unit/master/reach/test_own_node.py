"""What the appliance's own node may do: what an unmodified rosout asks for, and nothing else."""

import pytest

from appliance.master.calls.table import MASTER_CALLS
from appliance.master.graph.registry import Kind
from appliance.master.reach.own_node import ROSOUT

ROSOUTS = [
    ("registerPublisher", "/rosout_agg"),
    ("unregisterPublisher", "/rosout_agg"),
    ("registerSubscriber", "/rosout"),
    ("unregisterSubscriber", "/rosout"),
    ("registerService", "/rosout/get_loggers"),
    ("unregisterService", "/rosout/set_logger_level"),
    ("hasParam", "/tcp_keepalive"),
    ("getParam", "/use_sim_time"),
]


@pytest.mark.parametrize(("method", "resource"), ROSOUTS)
def test_rosout_may_be_rosout(method: str, resource: str) -> None:
    """It may do what it does when it starts and ends, under its own name only."""
    call = MASTER_CALLS[method]
    assert ROSOUT.decide("/rosout", call, (resource,)).allowed
    for other in ("/talker", "/rosrv", ""):
        decision = ROSOUT.decide(other, call, (resource,))
        assert not decision.allowed
        assert "may not speak as" in decision.reason


@pytest.mark.parametrize("method", MASTER_CALLS)
def test_it_may_do_nothing_else(method: str) -> None:
    """No call of the Master API is granted for another topic, service or parameter, and most are not granted at all."""
    call = MASTER_CALLS[method]
    for resource in ("/cmd_vel", "/secret", "/", "/talker/set_logger_level"):
        decision = ROSOUT.decide("/rosout", call, (resource, resource))
        assert not decision.allowed
        assert decision.reason.startswith("/rosout is the appliance's own node and may not ")
    granted = {name for name, _ in ROSOUTS}
    if method not in granted:
        for resource in ("/rosout", "/rosout_agg", "/use_sim_time"):
            assert not ROSOUT.decide("/rosout", call, (resource, resource)).allowed


def test_what_it_publishes_it_may_not_hear() -> None:
    """A right is one of a kind: the topic that it publishes is none that it subscribes to."""
    assert ROSOUT.may_have(Kind.PUBLICATION, "/rosout_agg")
    assert not ROSOUT.may_have(Kind.SUBSCRIPTION, "/rosout_agg")
    assert not ROSOUT.may_have(Kind.PARAMETER, "/use_sim_time")
