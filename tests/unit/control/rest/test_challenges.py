import pytest

from appliance.control.rest.rest_proof import SECONDS, ChallengeRefusedError, Challenges


def refusal(challenges: Challenges, challenge: str, now: float) -> str:
    try:
        challenges.take(challenge, now)
    except ChallengeRefusedError as error:
        return str(error)
    return ""


def test_each_is_valid_once_and_until_its_end() -> None:
    challenges = Challenges()
    first, second = challenges.give(100.0), challenges.give(100.0)
    assert refusal(challenges, first, 100.0 + SECONDS - 0.01) == ""
    assert "already" in refusal(challenges, first, 100.0 + SECONDS - 0.01)
    assert "expired" in refusal(challenges, second, 100.0 + SECONDS)
    assert "expired" in refusal(challenges, first, 100.0 + SECONDS)


@pytest.mark.parametrize("text", ["", ".", "..", "9e9.x.y", "nan.x.y", "é", "99999999.000.x." + "0" * 64])
def test_only_this_process_makes_valid_ones(text: str) -> None:
    challenges = Challenges()
    given = challenges.give(1.0)
    assert "has not issued this challenge" in refusal(challenges, text, 1.0)
    assert "has not issued this challenge" in refusal(challenges, given.replace("61.000", "99961.000"), 1.0)
    assert "has not issued this challenge" in refusal(Challenges(), given, 1.0)
    assert refusal(challenges, given, 1.0) == ""


def test_used_challenges_are_bounded() -> None:
    challenges = Challenges()
    refused = [refusal(challenges, challenges.give(5.0), 5.0) for _ in range(5000)]
    assert refused[:4096] == [""] * 4096
    assert all("wait" in one for one in refused[4096:])
    later = 5.0 + SECONDS
    assert [refusal(challenges, challenges.give(later), later) for _ in range(4096)] == [""] * 4096
