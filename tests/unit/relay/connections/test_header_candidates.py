import pytest

from appliance.relay.connections.header_candidates import HeaderCandidates
from appliance.relay.loop import EventLoop
from tests.unit.relay.connections.test_relayed_topic import RecordedMember, Story
from tests.unit.relay.contexts import context_of

STRING, MD5 = "std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1"
SUBSCRIBER = {"callerid": "/listener", "topic": "/chatter", "type": STRING, "md5sum": MD5}
UNTYPED = {"callerid": "/echo", "topic": "/chatter", "type": "*", "md5sum": "*"}
WRONG = {"type": "std_msgs/Bool", "md5sum": "8b94c1b53db61fb6aed406028ad6332a"}
DEFINED = {"type": STRING, "md5sum": MD5, "message_definition": "string data\n"}


def asked(claims: list[dict[str, str]], registered: str) -> list[str]:
    candidates = HeaderCandidates(lambda: claims, lambda: registered)
    shown = [_shown(candidates)]
    while candidates.advance():
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
    assert candidates.advance()
    candidates.accepted()
    assert (candidates.fields["type"], candidates.fields["md5sum"]) == (STRING, MD5)
    assert candidates.advance()  # the publisher has changed its mind: another claim is left
    assert candidates.fields["md5sum"] == "*"


@pytest.mark.parametrize("hosts", [1, 3, 7])
@pytest.mark.parametrize("alike", [1, 5])
@pytest.mark.parametrize("types", [1, 8, 9, 40])
def test_each_type_of_a_subscriber_is_tried_in_turn(types: int, alike: int, hosts: int) -> None:
    story, loop = Story(), EventLoop()
    for number in range(types * alike):
        member = RecordedMember(host=f"10.0.0.{number % hosts}", caller_id=f"/n_{number}")
        member.fields = {"type": STRING, "md5sum": f"md5sum of {number // alike}"}
        story.topic.join(member)
    candidates = HeaderCandidates.of(context_of(loop), story.topic)

    def next_row() -> list[str]:
        row = []
        while candidates.advance():
            row.append(candidates.fields["md5sum"])
        return row

    rows = [next_row() for _ in range(-(-types // 8))]
    tried = [md5sum for row in rows for md5sum in row if md5sum != "*"]
    assert sorted(tried) == sorted(f"md5sum of {number}" for number in range(types))
    assert all(len(row) <= 8 + 1 for row in rows)
    assert next_row() == rows[0]
    loop.close()


def test_a_host_that_makes_up_types_hides_no_subscriber_of_another() -> None:
    story, loop = Story(), EventLoop()
    for number in range(100):
        member = RecordedMember(host="10.0.0.66" if number < 99 else "10.0.0.2", caller_id=f"/n_{number}")
        member.fields = {"type": "a/B", "md5sum": str(number)}
        story.topic.join(member)
    candidates = HeaderCandidates.of(context_of(loop), story.topic)
    asked_for = [candidates.fields["md5sum"] for _ in range(3) if candidates.advance()]
    assert asked_for == ["0", "99", "1"]
    loop.close()
