import pytest

from appliance.channel.messages import UpstreamWanted
from appliance.relay.connections.relayed_topic import RelayedTopic
from appliance.relay.connections.upstream import PublisherConnection, UpstreamState
from appliance.relay.relay_limits import RelayLimits
from tests.unit.relay.contexts import context_of
from tests.unit.relay.monitors.quiet import Reports, Timers


@pytest.mark.parametrize(("unsettled", "seconds"), [(False, 0.0), (True, RelayLimits().linger)])
def test_a_lazy_publisher_learns_at_once_that_it_has_no_subscriber(unsettled: bool, seconds: float) -> None:
    loop, reports = Timers(), Reports()
    context = context_of(loop, reporter=reports)
    if unsettled:
        context.table.begin(1)
    topic = RelayedTopic(
        "k", "/chatter", "/talker", "10.0.0.2", grace=0.05, clock=loop.clock,
        share=context.memory.latched.of("10.0.0.2"), fresh=not unsettled, limited=lambda *_: None,
        make_room=lambda _size: None, refused=reports.send, sink=None,
    )  # fmt: skip
    publisher = PublisherConnection(context, topic)
    publisher.connect()
    publisher.release()
    due, timer = loop.due[-1]
    assert due == seconds and timer.callback is not None
    timer.callback()
    assert publisher.state is UpstreamState.IDLE
    publisher.connect()
    assert reports.sent == [UpstreamWanted("k", "/chatter")] * 2
