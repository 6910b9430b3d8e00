"""Which kept revision somebody means who wants to go back."""

from typing import NamedTuple

import pytest

from appliance.store.revisions import UnknownRevisionError, wanted


class Row(NamedTuple):
    """A kept revision."""

    revision: int


ROWS = [Row(7), Row(5), Row(4)]


def test_without_a_number_it_is_the_one_before() -> None:
    """The last that is kept below the present one, also where numbers are missing."""
    assert wanted(ROWS, None, 7) == Row(5)
    assert wanted(ROWS, 4, 7) == Row(4)


@pytest.mark.parametrize(("asked", "said"), [(None, "before this one"), (0, "0"), (6, "6")])
def test_the_error_says_what_was_asked_for_and_what_there_is(asked: int | None, said: str) -> None:
    """Revision 0 is a number as any other."""
    with pytest.raises(UnknownRevisionError, match=f"^there is no revision {said}; kept are: 4, 5, 7$"):
        wanted(ROWS, asked, 4)
