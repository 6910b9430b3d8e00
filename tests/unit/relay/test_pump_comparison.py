import gc

import pytest

from appliance.relay.transport.pump import ModuleCall
from tests.support.stated import stated
from tests.unit.relay.monitors.monitored import string
from tests.unit.relay.pump_comparison import ComparedRelay, PumpComparison

pytestmark = pytest.mark.usefixtures("sockets")

_SEED = 20261124
_COUNTS = "counts() { int n; event e(std::string s) /chatter std_msgs/String '{data:s}' { n = n + 1; } }"


@pytest.mark.nightly
@pytest.mark.timeout(600)
def test_the_pump_has_the_same_effects_as_python() -> None:
    comparison = PumpComparison(_SEED)
    try:
        comparison.run(18_000)
    except AssertionError as error:
        raise AssertionError(f"python -m tests.unit.relay.pump_comparison {_SEED} 18000: {error}") from error
    finally:
        comparison.close()
    done = comparison.done
    assert done["pump: without Python"] > 5 + done["plain: without Python"]


@pytest.mark.nightly  # other tests of the process may have objects of the kind
def test_a_quiet_publisher_keeps_no_earlier_module() -> None:
    others, relay = _calls(), ComparedRelay(pumped=True)
    try:
        relay.subscribe("/chatter", "/listener")
        relay.state(stated(1, [("counts.rv", _COUNTS)]))
        relay.answered(1)
        for _ in range(3):
            relay.publishers["/chatter"].send(string("one"))
            relay.expected["/chatter"] += 1
            relay.take_all()
        assert _calls() - others
        relay.state(stated(2, []))
        relay.answered(2)
        assert not _calls() - others
    finally:
        relay.close()


def test_counters_that_are_read_between_messages_lose_no_event() -> None:
    relay = ComparedRelay(pumped=True)
    try:
        relay.subscribe("/chatter", "/listener")
        relay.state(stated(1, [("counts.rv", _COUNTS)]))
        relay.answered(1)
        for _ in range(5):
            relay.publishers["/chatter"].send(string("one"))
            relay.expected["/chatter"] += 1
            relay.take_all()
            relay.totals()
        relay.state(stated(2, [("counts.rv", _COUNTS), ("other.rv", _COUNTS.replace("counts", "other"))]))
        relay.answered(2)
        assert [row.events for row in relay.totals()["rows"]] == [5, 0]
    finally:
        relay.close()


def _calls() -> set[int]:
    gc.collect()
    return {id(each) for each in gc.get_objects() if isinstance(each, ModuleCall)}
