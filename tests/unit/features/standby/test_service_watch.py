from appliance.features.standby.process import (
    AGAIN_SECONDS,
    OBSTACLE_SECONDS,
    RESTART_SECONDS,
    SILENT_SECONDS,
    START_SECONDS,
    ServiceWatch,
)


def serving() -> ServiceWatch:
    watch = ServiceWatch()
    assert watch.fault(100.0, active=True) == ""
    watch.linked()
    watch.reported(102.0, "", keeps_state=False)
    return watch


def test_a_start_has_some_seconds() -> None:
    watch = ServiceWatch()
    assert watch.fault(90.0, active=False) == watch.fault(100.0, active=True) == ""
    assert watch.fault(100.0 + START_SECONDS, active=True) == ""
    assert watch.fault(100.1 + START_SECONDS, active=True) == "control has not been ready for 5.1 s"
    assert watch.fault(200.0, active=False) == ""


def test_a_lease_that_comes_back_before_control() -> None:
    for keeps_state in (True, False):
        watch = serving()
        watch.reported(102.5, "", keeps_state=keeps_state)
        assert watch.fault(103.0, active=False) == ""
        assert ("just started" in watch.fault(103.3, active=True, present=False)) is not keeps_state
        watch.reported(105.0, "", keeps_state=keeps_state)
        assert watch.fault(105.0 + SILENT_SECONDS, active=True) == ""
        assert watch.fault(105.1 + SILENT_SECONDS, active=True)


def test_a_control_that_hangs_and_one_that_starts_again() -> None:
    watch = serving()
    assert watch.fault(102.0 + SILENT_SECONDS, active=True) == ""
    assert watch.fault(102.1 + SILENT_SECONDS, active=True) == "control has not reported for 4.1 s"
    watch.linked()
    assert watch.fault(102.0 + RESTART_SECONDS, active=True) == ""
    assert "not been ready" in watch.fault(102.1 + RESTART_SECONDS, active=True)


def test_an_obstacle_that_lasts() -> None:
    watch = serving()
    for now in (103.0, 102.9 + OBSTACLE_SECONDS):
        watch.reported(now, "full", keeps_state=False)
        assert watch.fault(now, active=True) == ""
    assert watch.fault(103.1 + OBSTACLE_SECONDS, active=True) == "full"
    watch.reported(105.0, "", keeps_state=False)
    assert watch.fault(105.0, active=True) == ""


def test_it_keeps_the_lease_for_ten_minutes_after_it_gave_it_away() -> None:
    """Two that cannot serve, for whatever reason, do not pass it back and forth. It reports the reason all the time."""
    watch = serving()
    assert watch.kept_for(103.0) == 0.0
    watch.reported(103.0, "full", keeps_state=False)
    watch.given_away(105.0)
    assert watch.fault(106.0, active=False) == watch.fault(110.0, active=True) == ""
    watch.reported(110.0, "full", keeps_state=False)
    assert watch.fault(112.0, active=True) == "full"
    assert watch.kept_for(112.0) == AGAIN_SECONDS - 7.0
    assert watch.kept_for(105.0 + AGAIN_SECONDS) == 0.0


def test_a_minute_of_service_ends_that_time() -> None:
    """A later full disk of this appliance has nothing to do with the earlier one."""
    watch = serving()
    watch.given_away(105.0)
    assert watch.fault(106.0, active=False) == watch.fault(110.0, active=True) == ""
    for seconds, obstacle in ((0.0, ""), (30.0, "full"), (31.0, ""), (91.0, "")):
        watch.reported(110.0 + seconds, obstacle, keeps_state=False)
        assert watch.kept_for(110.0 + seconds)
    watch.reported(201.1, "", keeps_state=False)
    assert watch.kept_for(201.1) == 0.0
