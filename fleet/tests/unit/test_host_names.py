import pytest
from rosrv_fleet.host_names import CollectorNames

NAMES = CollectorNames(["fleet.example.com", "*.hall.example.com"])


@pytest.mark.parametrize(
    ("headers", "included"),
    [
        (["fleet.example.com"], True),
        (["Fleet.Example.com.:8444"], True),
        (["a.hall.example.com"], True),
        (["localhost:8444"], True),
        (["10.0.0.5:8444"], True),
        (["[fd00::5]:8444"], True),
        (["[fd00::5]"], True),
        (["evil.example.org"], False),
        (["fleet.example.com.evil.org"], False),
        (["evil-fleet.example.com"], False),
        (["hall.example.com"], False),
        (["a.b.hall.example.com"], False),
        (["[fd00::5]evil.org"], False),
        ([""], False),
        ([], False),
        (["fleet.example.com", "fleet.example.com"], False),
    ],
)
def test_only_names_of_the_collector_are_answered(headers: list[str], included: bool) -> None:
    assert NAMES.include(headers) is included
