import pytest

from appliance.features.standby.process import (
    OBSTACLE_SECONDS,
    RESTART_SECONDS,
    SILENT_SECONDS,
    START_SECONDS,
    STEADY_SECONDS,
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
        watch.given_away()
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


@pytest.mark.parametrize(("seconds", "factor"), [(STEADY_SECONDS - 1, 2), (STEADY_SECONDS + 1, 1)])
def test_two_appliances_do_not_pass_the_lease_back_and_forth(seconds: float, factor: int) -> None:
    watch = serving()
    watch.reported(102.0 + seconds, "", keeps_state=False)
    watch.given_away()
    assert watch.fault(200.0, active=False) == watch.fault(200.0, active=True) == ""
    assert watch.fault(200.0 + factor * START_SECONDS, active=True) == ""
    assert watch.fault(200.1 + factor * START_SECONDS, active=True)


def test_steady_service_ends_the_doubled_times() -> None:
    """After a month of service, a full disk is not tolerated for 38 s because of earlier short activations."""
    watch = serving()
    for start in (200.0, 300.0, 400.0, 500.0, 600.0):
        watch.given_away()
        assert watch.fault(start - 1, active=False) == watch.fault(start, active=True) == ""
        watch.reported(start + 1, "", keeps_state=False)
    watch.reported(601.1 + STEADY_SECONDS, "", keeps_state=False)
    watch.reported(700.0, "full", keeps_state=False)
    assert watch.fault(700.1 + OBSTACLE_SECONDS, active=True) == "full"
