import struct
from collections.abc import Iterator

import pytest

from appliance.channel.messages import LookEnded, LookWanted, MessageSeen
from appliance.relay.topic_taps import MAX_LOOKS, MAX_MESSAGES
from roswire.tcpros import encode_frame
from tests.unit.relay.world import HEADER, World

pytestmark = pytest.mark.usefixtures("sockets")

TOLD = HEADER | {"message_definition": "string data\n"}


def text(word: str) -> bytes:
    return struct.pack("<I", len(word)) + word.encode()


def seen(world: World, word: str) -> MessageSeen:
    found: MessageSeen = world.until(
        lambda: next(
            (one for one in world.told if isinstance(one, MessageSeen) and one.fields == {"data": word}), None
        )
    )
    return found


@pytest.fixture
def world() -> Iterator[World]:
    world = World()
    yield world
    world.close()


def test_the_next_messages_are_shown_and_no_more(world: World) -> None:
    publisher, subscriber = world.subscribed(TOLD)
    world.state(LookWanted(1, "/chatter", 2, latched=True))
    frames = [encode_frame(text(word)) for word in ("one", "two", "three")]
    publisher.send(b"".join(frames))
    world.gets(subscriber, b"".join(frames))
    first = seen(world, "one")
    assert (first.number, first.key, first.type, first.size, first.why) == (1, "k", "std_msgs/String", 7, "")
    assert seen(world, "two").time >= first.time
    publisher.send(encode_frame(text("four")))
    world.gets(subscriber, encode_frame(text("four")))
    assert [one.fields["data"] for one in world.told if isinstance(one, MessageSeen)] == ["one", "two"]


def test_a_topic_without_subscribers_is_tapped(world: World) -> None:
    world.state(LookWanted(1, "/chatter", MAX_MESSAGES, latched=True))
    publisher = world.upstream(TOLD)
    publisher.send(encode_frame(text("alone")))
    assert seen(world, "alone").number == 1
    world.state(LookEnded(1))
    world.ends(publisher)


def test_the_latched_message_comes_first(world: World) -> None:
    publisher, subscriber = world.subscribed(TOLD | {"latching": "1"})
    publisher.send(encode_frame(text("kept")))
    world.gets(subscriber, encode_frame(text("kept")))
    world.state(LookWanted(1, "/chatter", 1, latched=True))
    assert seen(world, "kept").number == 1
    world.state(LookEnded(1))
    world.state(LookWanted(2, "/chatter", 2, latched=False))
    publisher.send(encode_frame(text("new")))
    assert seen(world, "new").number == 2
    assert [one.number for one in world.told if isinstance(one, MessageSeen)] == [1, 2]


def test_another_publisher_is_read_by_its_own_definition(world: World) -> None:
    publisher, _subscriber = world.subscribed(TOLD)
    world.state(LookWanted(1, "/chatter", 5, latched=True))
    publisher.send(encode_frame(text("one")))
    assert seen(world, "one").why == ""
    publisher.sock.close()
    again = world.upstream(HEADER | {"message_definition": "string word\n"})
    again.send(encode_frame(text("two")))
    world.until(
        lambda: any(isinstance(one, MessageSeen) and one.fields == {"word": "two"} for one in world.told)
    )


@pytest.mark.parametrize("definition", ["", "no/such field", "string data\n" * 3, "std_msgs/String data\n"])
def test_an_unreadable_definition_is_reported(world: World, definition: str) -> None:
    publisher, _subscriber = world.subscribed(HEADER | {"message_definition": definition})
    world.state(LookWanted(1, "/chatter", 1, latched=True))
    publisher.send(encode_frame(text("word")))
    shown = world.hears(MessageSeen)
    assert shown.fields == {"data": text("word").hex()}
    assert "the definition in the publisher's header cannot be read" in shown.why


def test_lengths_that_lie_are_shown_as_far_as_the_bytes_go(world: World) -> None:
    publisher, _subscriber = world.subscribed(TOLD)
    world.state(LookWanted(1, "/chatter", 1, latched=True))
    publisher.send(encode_frame(struct.pack("<I", 1 << 31) + b"x"))
    assert world.hears(MessageSeen).fields == {"data": "…"}


def test_taps_are_few_and_end_with_control(world: World) -> None:
    publisher, subscriber = world.subscribed(TOLD)
    for number in range(MAX_LOOKS + 1):
        world.state(LookWanted(number, "/chatter", 1, latched=True))
    publisher.send(encode_frame(text("word")))
    world.until(lambda: sum(isinstance(one, MessageSeen) for one in world.told) == MAX_LOOKS)
    world.gets(subscriber, encode_frame(text("word")))
    world.engine.attach(None)
    world.link.close()
    world.control.close()
    world.connect_control()
    world.state(LookWanted(99, "/chatter", 1, latched=True))
    publisher.send(encode_frame(text("again")))
    assert seen(world, "again").number == 99
