"""Tests of `appliance.supervisor.process_handle`: which process hangs, and which is only slow."""

import pytest

from appliance.supervisor.process_handle import (
    ANSWER_SECONDS,
    FIRST_ANSWER_SECONDS,
    LONGEST_START_SECONDS,
    hangs,
)


@pytest.mark.parametrize(
    ("silent", "starting", "still", "hanging"),
    [
        (ANSWER_SECONDS + 1, False, 0.0, True),
        (ANSWER_SECONDS - 1, False, 4.0, False),
        (ANSWER_SECONDS + 1, True, 0.0, False),
        (10 * FIRST_ANSWER_SECONDS, True, 1.0, False),
        (FIRST_ANSWER_SECONDS + 1, True, ANSWER_SECONDS + 1, True),
        (LONGEST_START_SECONDS + 1, True, 0.0, True),
    ],
)
def test_a_slow_start_is_waited_for_and_a_hang_is_not(
    silent: float, starting: bool, still: float, hanging: bool
) -> None:
    """A process that serves must answer within seconds; one that starts must only get on."""
    assert hangs(silent, starting=starting, still=still) is hanging
