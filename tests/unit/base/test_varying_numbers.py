import pytest

from appliance.base.varying_numbers import without_numbers


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("speed 0.45 m/s, limit 0.3", "speed # m/s, limit #"),
        ("(-1.5e-07, nan, +inf)", "(#, #, #)"),
        ("v=7", "v=#"),
        ("12m away.", "#m away."),
        ("waits 3.", "waits #."),
        ("joint_1 of /arm/2", "joint_1 of /arm/2"),
        ("host 10.0.0.66", "host 10.0.0.66"),
        ("host 2001:db8::42, 3 times", "host 2001:db8::42, # times"),
        ("::1 and fe80:1:2:3:4:5:6:7: 2", "::1 and fe80:1:2:3:4:5:6:7: #"),
        ("at 10:32:05", "at #:#:#"),
        ("limit.rv:12:4: 3 is too many", "limit.rv:12:4: # is too many"),
        ("infinite nanny", "infinite nanny"),
    ],
)
def test_only_values_are_replaced(text: str, words: str) -> None:
    assert without_numbers(text) == words
