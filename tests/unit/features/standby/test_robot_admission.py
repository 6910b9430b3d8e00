from appliance.base import clock
from appliance.features.standby.replication import RobotAdmission
from tests.support.virtual_clock import VirtualClock


def test_doubt_lasts_until_the_followers_have_asked_again() -> None:
    machine, doubts, ends = VirtualClock(), list[bool](), list[int]()
    with clock.using(machine):
        admission = RobotAdmission()
        admission.on_end_of_gap(lambda: ends.append(second))
        for second in range(12):
            doubts.append(admission.in_doubt())
            for _ in range(4):
                machine.advance(0.25)
                if second not in (5, 6):
                    admission.note_answer(clock.since_boot())
    assert ends == [7]
    assert doubts == [True, True, *[False] * 4, True, True, True, True, False, False]
