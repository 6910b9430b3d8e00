import pytest

from appliance.relay.connections.header_candidates import HeaderCandidates

STRING, MD5 = "std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1"
SUBSCRIBER = {"callerid": "/listener", "topic": "/chatter", "type": STRING, "md5sum": MD5}
UNTYPED = {"callerid": "/echo", "topic": "/chatter", "type": "*", "md5sum": "*"}
WRONG = {"type": "std_msgs/Bool", "md5sum": "8b94c1b53db61fb6aed406028ad6332a"}
DEFINED = {"type": STRING, "md5sum": MD5, "message_definition": "string data\n"}


def asked(claims: list[dict[str, str]], registered: str) -> list[str]:
    candidates = HeaderCandidates(lambda: claims, lambda: registered)
    shown = [_shown(candidates)]
    while candidates.refused():
        shown.append(_shown(candidates))
    assert _shown(candidates) == shown[0]  # from the start, at the next attempt
    return shown


def _shown(candidates: HeaderCandidates) -> str:
    fields = candidates.fields
    definition = fields.get("message_definition")
    return f"{fields['type']} {fields['md5sum'][:4]}" + ("" if definition is None else f" {definition!r}")


@pytest.mark.parametrize(
    ("claims", "registered", "expected"),
    [
        ([], "*", ["* *", "* * ''"]),
        ([], STRING, ["* *", f"{STRING} * ''"]),
        ([SUBSCRIBER], "*", ["* *", f"{STRING} 992c ''", "* * ''"]),
        ([UNTYPED, SUBSCRIBER], STRING, ["* *", f"{STRING} 992c ''", f"{STRING} * ''"]),
        ([{}, DEFINED, SUBSCRIBER], STRING, ["* *", f"{STRING} 992c 'string data\\n'", f"{STRING} * ''"]),
        ([WRONG, SUBSCRIBER], STRING, ["* *", "std_msgs/Bool 8b94 ''", f"{STRING} 992c ''", f"{STRING} * ''"]),
        ([{"md5sum": MD5, "type": "*"}], STRING, ["* *", f"{STRING} 992c ''", f"{STRING} * ''"]),
    ],
)  # fmt: skip
def test_a_publisher_is_asked_with_each_known_type(
    claims: list[dict[str, str]], registered: str, expected: list[str]
) -> None:
    assert asked(claims, registered) == expected


def test_subscribers_do_not_choose_how_often_a_publisher_is_asked() -> None:
    assert len(asked([{"type": "a/B", "md5sum": f"{number}"} for number in range(100)], "*")) == 1 + 8 + 1


def test_an_accepted_header_is_used_again() -> None:
    candidates = HeaderCandidates(lambda: [SUBSCRIBER], lambda: STRING)
    assert candidates.refused()
    candidates.accepted()
    assert (candidates.fields["type"], candidates.fields["md5sum"]) == (STRING, MD5)
    assert candidates.refused()  # the publisher has changed its mind: another claim is left
    assert candidates.fields["md5sum"] == "*"
