"""Tests of `appliance.api.preconditions`."""

import pytest

from appliance.api.preconditions import etag, expected_revision, expected_tag
from appliance.api.problems import ProblemError


def test_an_etag_names_its_revision() -> None:
    """What GET gives is what a change takes; `*` is whichever is in force."""
    assert expected_revision(etag(7)) == 7
    assert expected_revision(f" {etag(123456)} ") == 123456
    assert expected_revision("*") is None
    assert expected_tag(etag("3.12"), "monitors", "/v1/monitors") == "3.12"
    assert expected_tag("*", "monitors", "/v1/monitors") is None


@pytest.mark.parametrize(
    ("header", "status"),
    [
        (None, 428),
        ("", 412),
        ("7", 412),
        ('W/"7"', 412),
        ('"7", "8"', 412),
        ('"-1"', 412),
        ('"' + "9" * 30 + '"', 412),
    ],
)
def test_anything_else_is_refused(header: str | None, status: int) -> None:
    """Missing is 428; a weak, unquoted, multiple or impossible tag can never match, so it is 412."""
    with pytest.raises(ProblemError) as caught:
        expected_revision(header)
    assert caught.value.status == status


@pytest.mark.parametrize("header", ["", "3.12", 'W/"3.12"', '"3.12", "3.13"', '""', '"' + "9" * 91 + '"'])
def test_what_is_no_tag_is_refused(header: str) -> None:
    """Of what has tags of its own, the same."""
    with pytest.raises(ProblemError) as caught:
        expected_tag(header, "monitors", "/v1/monitors")
    assert caught.value.status == 412
