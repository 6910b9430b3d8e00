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
    assert senders.names(other) == senders.names(0) == ("", "")
