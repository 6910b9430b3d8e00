import pytest

from appliance.base.counted import counted


@pytest.mark.parametrize(
    ("number", "forms", "text"),
    [
        (0, ("host",), "0 hosts"),
        (1, ("host",), "1 host"),
        (2, ("host",), "2 hosts"),
        (1, ("host is", "hosts are"), "1 host is"),
        (3, ("host is", "hosts are"), "3 hosts are"),
    ],
)
def test_a_number_has_its_noun_and_verb_in_the_right_form(
    number: int, forms: tuple[str, ...], text: str
) -> None:
    assert counted(number, *forms) == text
