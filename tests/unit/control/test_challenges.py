"""Tests of `appliance.control.challenges`."""

import pytest

from appliance.control.challenges import SECONDS, ChallengeRefusedError, Challenges


def refusal(challenges: Challenges, challenge: str, now: float) -> str:
    """Why a challenge is not taken; empty when it is."""
    try:
        challenges.take(challenge, now)
    except ChallengeRefusedError as error:
        return str(error)
    return ""


def test_each_is_good_once_and_not_for_long() -> None:
    """It is taken until its end, never twice, and after its end not at all."""
    challenges = Challenges()
    first, second = challenges.give(100.0), challenges.give(100.0)
    assert refusal(challenges, first, 100.0 + SECONDS - 0.01) == ""
    assert "already" in refusal(challenges, first, 100.0 + SECONDS - 0.01)
    assert "ended" in refusal(challenges, second, 100.0 + SECONDS)
    assert "ended" in refusal(challenges, first, 100.0 + SECONDS)


@pytest.mark.parametrize("text", ["", ".", "..", "9e9.x.y", "nan.x.y", "é", "99999999.000.x." + "0" * 64])
def test_nobody_else_makes_one(text: str) -> None:
    """What this process has not given is refused: made up, with another end, or of the process before it."""
    challenges = Challenges()
    given = challenges.give(1.0)
    assert "none that RVMaster gave" in refusal(challenges, text, 1.0)
    assert "none that RVMaster gave" in refusal(challenges, given.replace("61.000", "99961.000"), 1.0)
    assert "none that RVMaster gave" in refusal(Challenges(), given, 1.0)
    assert refusal(challenges, given, 1.0) == ""


def test_what_was_taken_does_not_pile_up() -> None:
    """So many are remembered, and forgotten when they have ended; asking for more fills nothing."""
    challenges = Challenges()
    refused = [refusal(challenges, challenges.give(5.0), 5.0) for _ in range(5000)]
    assert refused[:4096] == [""] * 4096
    assert all("wait" in one for one in refused[4096:])
    later = 5.0 + SECONDS
    assert [refusal(challenges, challenges.give(later), later) for _ in range(4096)] == [""] * 4096
