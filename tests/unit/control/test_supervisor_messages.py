"""The records that control makes of the supervisor's reports."""

from appliance.channel.messages import ProcessDied
from appliance.control.process import record_death
from tests.support.core import FakeTrail


def test_an_unexpected_end_of_a_process_is_recorded() -> None:
    trail = FakeTrail()
    death = ProcessDied("relay", 1, 77, "signal SIGKILL", "it ended with signal SIGKILL", 2.5, 3)
    record_death(trail, death)
    [row] = trail.rows
    assert (row["event"], row["resource"]) == ("process died", "relay")
    assert row["reason"] == "relay: it ended with signal SIGKILL"
    assert (row["index"], row["pid"], row["end"], row["lived"], row["restarts"]) == (
        1,
        77,
        "signal SIGKILL",
        2.5,
        3,
    )
