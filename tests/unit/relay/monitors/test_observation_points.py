from unittest import mock

from hypothesis import given
from hypothesis import strategies as st

from appliance.relay.monitors import observation_points
from appliance.relay.monitors.observation_points import ObservationPoint, Senders


class Pipeline:
    def __init__(self, point: ObservationPoint) -> None:
        self.point = point


def test_many_new_senders_do_not_make_a_live_one_unknown() -> None:
    senders, held = Senders(), Pipeline(ObservationPoint("k", "/cmd_vel", "10.0.0.7", "/teleop"))
    number, other = senders.number(held.point), senders.number(ObservationPoint("k", "/a", "10.0.0.9", "/a"))
    senders.hold(number, held)
    for place in range(5000):
        senders.number(ObservationPoint("k", "/set", "10.0.0.8", f"/guest{place}"))
    assert senders.names(number) == ("10.0.0.7", "/teleop")
    assert senders.point(number) == held.point
    assert senders.names(other) == senders.names(0) == ("", "")
    assert senders.point(other) is None


@given(
    st.lists(
        st.tuples(st.sampled_from(["hold", "release", "number"]), st.integers(0, 9)), min_size=30, max_size=60
    )
)
def test_a_number_has_its_point_as_long_as_its_holder_lives(operations: list[tuple[str, int]]) -> None:
    with mock.patch.object(observation_points, "_SENDERS", 3):
        senders, held = Senders(), dict[int, Pipeline]()
        for operation, place in operations:
            point = ObservationPoint("k", "/chatter", "10.0.0.7", f"/guest{place}")
            if operation == "release":
                held = {number: one for number, one in held.items() if one.point != point}
            elif (number := senders.number(point)) and operation == "hold":
                held[number] = Pipeline(point)
                senders.hold(number, held[number])
            for number, one in held.items():
                assert senders.point(number) == one.point
                assert senders.names(number) == (one.point.host, one.point.caller_id)
