from appliance.base import clock
from appliance.base.deadlines import Deadlines
from tests.support.virtual_clock import VirtualClock


def test_a_step_back_of_the_clock_postpones_no_end() -> None:
    machine = VirtualClock(wall=10_000.0)
    with clock.using(machine):
        ends = Deadlines()
        assert not ends.passed("a", 10_100.0)
        machine.advance(60)
        machine.set_wall(1_000.0)
        assert not ends.passed("a", 10_100.0)
        machine.sleep(50)
        assert ends.passed("a", 10_100.0), "its hundred seconds are over, whatever the clock shows"
        assert not ends.passed("b", 1_200.0)
        machine.set_wall(20_000.0)
        assert ends.passed("b", 1_200.0)
        machine.set_wall(1_100.0)
        assert not ends.passed("b", 1_300.0), "a new end is compared with the present clock"
