import pytest

from appliance.base import clock
from appliance.channel.messages import StateGiven
from appliance.relay.monitors.state_keeper import StateKeeper
from rosmop.tests.acting import message
from tests.support.virtual_clock import VirtualClock
from tests.unit.relay.monitors.quiet import QuietMonitors

SIZE = 1 << 20
WALL = 1_790_000_000.0
HALT = """hold halted() {
    event halt(bool on) /halt std_msgs/Bool '{data:on}' { }
    event drive() /cmd_vel geometry_msgs/Twist '{}' { }
    mtl: drive => not once[0,60s] halt
    @violation { DROP; }
}"""


class Relay:
    def __init__(self, machine: VirtualClock, memory: bytearray, boot: str, **stated: object) -> None:
        self.machine = machine
        with clock.using(machine):
            given = StateGiven(True, boot, machine.wall_ns() - machine.now_ns())
            self.keeper = StateKeeper(given, memory)
            self.monitors = QuietMonitors()
            self.monitors.interceptor.remember(self.keeper)
            self.monitors.load(HALT, **stated)

    def send(self, topic: str, type_name: str, **fields: object) -> str:
        with clock.using(self.machine):
            time = self.monitors.interceptor.now()
            result = self.monitors.process(topic, message(type_name, **fields), time).result
            self.keeper.keep(topic)
        return result

    def drive(self) -> str:
        return self.send("/cmd_vel", "geometry_msgs/Twist")

    def left(self) -> tuple[bytes]:
        with clock.using(self.machine):
            return (self.keeper.content(),)


@pytest.mark.parametrize("ahead", [0.0, 120.0, -120.0, 3600.0, -3600.0])
def test_bounds_are_ages_over_a_switchover_and_a_crash(ahead: float) -> None:
    one, other = VirtualClock(wall=WALL, now=5.0), VirtualClock(wall=WALL + ahead, now=7000.0)

    def let_pass(seconds: float) -> None:
        one.advance(seconds)
        other.advance(seconds)

    first = Relay(one, bytearray(SIZE), "one")
    assert first.drive() == "passed"
    first.send("/halt", "std_msgs/Bool", data=True)
    let_pass(20.0)
    assert first.drive() == "dropped"
    memory = bytearray(SIZE)
    second = Relay(other, memory, "other", left=first.left())
    let_pass(20.0)
    assert second.drive() == "dropped"
    second = Relay(other, memory, "other")  # the relay died
    assert second.drive() == "dropped"
    let_pass(19.0)
    assert second.drive() == "dropped"
    third = Relay(one, bytearray(SIZE), "one", left=second.left())
    assert third.drive() == "dropped"
    let_pass(2.0)
    assert third.drive() == "passed"


def test_a_copy_is_as_old_as_its_last_note() -> None:
    one, other = VirtualClock(wall=WALL, now=5.0), VirtualClock(wall=WALL + 3600.0, now=7000.0)
    first = Relay(one, bytearray(SIZE), "one")
    first.send("/halt", "std_msgs/Bool", data=True)
    copy = first.left()
    one.advance(30.0)
    with clock.using(one):
        noted = first.keeper.offset + clock.now_ns()
    second = Relay(other, bytearray(SIZE), "other", left=copy, left_at=noted)
    other.advance(29.0)
    assert second.drive() == "dropped"
    other.advance(2.0)
    assert second.drive() == "passed"
