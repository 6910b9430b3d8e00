import pytest

from appliance.relay.connections.subscriber import describe_mismatch

OFFERED = {"type": "std_msgs/String", "md5sum": "aaa"}


@pytest.mark.parametrize(
    "wanted",
    [
        {"type": "std_msgs/String", "md5sum": "aaa"},
        {"type": "*", "md5sum": "*"},
        {"type": "other/Same", "md5sum": "aaa"},
        {"md5sum": "*"},
    ],
)
def test_the_md5sum_decides_and_an_asterisk_fits_all(wanted: dict[str, str]) -> None:
    assert describe_mismatch(wanted, OFFERED) == ""
    assert describe_mismatch(wanted | {"md5sum": "bbb"}, OFFERED | {"md5sum": "*"}) == ""


def test_a_mismatch_names_both_sides() -> None:
    assert describe_mismatch({"type": "std_msgs/Int32", "md5sum": "b"}, OFFERED) == (
        "topic types do not match: [std_msgs/Int32] vs. [std_msgs/String]"
    )
    text = describe_mismatch(
        {"type": "std_msgs/String", "md5sum": "b", "callerid": "/l", "topic": "/t"}, OFFERED
    )
    assert "[/l] wants topic [/t]" in text
    assert "[std_msgs/String/b]" in text
    assert "[std_msgs/String/aaa]" in text
