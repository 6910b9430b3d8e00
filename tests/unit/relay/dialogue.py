"""Dialogues of control and peers with a relay as text. Each line is a step, which must happen.

Steps (`Dialogue.say`): a word with `=` is an equal field, a word with `~` a field that contains the text.

    listener asks callerid=/x | client calls            a peer connects with a header
    talker publishes latching=1 | server serves         a peer accepts the relay's connection and answers with a header
    server accepts | talker accepts-relay               the same without an answer
    talker sends one two*3 | talker pushes x^9000       frames (`x^9000` is nine thousand times x); `pushes` if large
    client sends hex:01 | server sends reply:hex:01     a frame of these bytes, the reply of a service
    x sends-header callerid=/x | talker sends-half one  a header of these fields alone, the first half of a frame
    listener gets one two | listener gets-header latching=1 | listener gets-fields callerid=/talker (and no others)
    listener is-served latching=1 | client is-answered  the peer is sent the header of the publisher or of the service
    listener is-served-by talker latching=1             the same after `listener asks` and `talker publishes latching=1`
    listener closes | listener resets | service closes  the peer ends its connection, the service listens no more
    listener ends [reply:hex:01] | listener stays       the relay has closed the connection (after this), or has not
    state GrantInstalled k /chatter 127.0.0.1 /late     a message of control
    hears ConnectionRefused caller_id=/late reason~no   a report to control
    client has-nothing                                  the peer has been sent nothing since
    quiet UpstreamWanted                                no report of this kind has come
    carried /chatter 2 14                               messages and bytes of a topic or service, in all reports
    waiting 2 | arriving 0 | clients 0 | connected 0 | held 0
                                                        peers without a grant, those with a header to come, clients of
                                                        services, connections, bytes of messages
    pause 0.3                                           the loop turns for this time

A relay with monitors has more steps. Its specifications are in `SPECIFICATIONS`.

    load GUARD|"bad"|"worse" restarted guard=off        load specifications, with a text replaced
    taken began=guard held= | refused ~text             the relay's answer
    event drop monitor=guard count=0 before=bad         an action of a monitor
    counts guard drops=1                                the counters of a monitor
    appliance publishes /chatter stop                   a message of the appliance itself to a topic
    second held | second ends                           events are counted until the second ends
"""

import shlex
from collections.abc import Callable
from typing import Any, ClassVar

from appliance.channel import messages
from appliance.channel.messages import Message
from roswire.tcpros import encode_frame, encode_header, encode_service_error, encode_service_reply
from tests.unit.relay.world import ASK, CALL, HEADER, LOOPBACK, SERVED, Peer, World


class Dialogue:
    """Steps of control and peers in a world. `string` makes the frame of a word."""

    served: ClassVar = SERVED
    asked = ASK
    published = HEADER

    def __init__(self, world: World) -> None:
        self.world = world
        self.peers: dict[str, Peer] = {}

    def say(self, line: str) -> None:
        who, *words = shlex.split(line)
        step = getattr(self, f"_{who}", None)
        if step is not None:
            step(*words)
        else:
            getattr(self, "_peer_" + words[0].replace("-", "_"))(who, *words[1:])

    def string(self, word: str) -> bytes:
        return encode_frame(word.encode())

    def _bytes(self, words: tuple[str, ...]) -> bytes:
        data = b""
        for word in words:
            text, _, times = word.partition("*")
            data += self._payload(text) * int(times or 1)
        return data

    def _payload(self, word: str) -> bytes:
        kind, _, rest = word.partition(":")
        match kind:
            case "reply":
                return encode_service_reply(bytes.fromhex(rest.removeprefix("hex:")))
            case "error":
                return encode_service_error(rest)
            case "hex":
                return encode_frame(bytes.fromhex(rest))
            case _:
                part, _, times = word.partition("^")
                return self.string(part * int(times or 1))

    # --- peers ---

    def _peer_asks(self, who: str, *words: str) -> None:
        self.peers[who] = self.world.connect(encode_header(self.asked | _given(words)))

    def _peer_calls(self, who: str, *words: str) -> None:
        self.peers[who] = self.world.connect(encode_header(CALL | _given(words)))

    def _peer_publishes(self, who: str, *words: str) -> None:
        self.peers[who] = self.world.upstream(self.published | _given(words))

    def _peer_accepts(self, who: str) -> None:
        self.peers[who] = self.world.accept(self.world.service)

    def _peer_accepts_relay(self, who: str) -> None:
        self.world.hears(messages.UpstreamWanted)
        where = self.world.publisher.getsockname()[1]
        self.world.state(messages.UpstreamFound("k", "/chatter", LOOPBACK, where))
        self.peers[who] = self.world.accept(self.world.publisher)

    def _peer_serves(self, who: str, *words: str) -> None:
        self._peer_accepts(who)
        self.world.gets_header(self.peers[who])
        self.peers[who].send(encode_header(self.served | _given(words)))

    def _peer_sends_header(self, who: str, *words: str) -> None:
        if who not in self.peers:
            self.peers[who] = self.world.connect()
        self.peers[who].send(encode_header(_given(words)))

    def _peer_sends_half(self, who: str, *words: str) -> None:
        data = self._bytes(words)
        self.peers[who].send(data[: len(data) // 2])

    def _peer_sends(self, who: str, *words: str) -> None:
        self.peers[who].send(self._bytes(words))

    def _peer_pushes(self, who: str, *words: str) -> None:
        self.world.push(self.peers[who], self._bytes(words))

    def _peer_gets(self, who: str, *words: str) -> None:
        self.world.gets(self.peers[who], self._bytes(words))

    def _peer_gets_header(self, who: str, *words: str) -> None:
        fields = self.world.gets_header(self.peers[who])
        assert agrees(fields, words), fields

    def _peer_is_served(self, who: str, *words: str) -> None:
        assert self.world.gets_header(self.peers[who]) == self.published | _given(words)

    def _peer_is_served_by(self, who: str, publisher: str, *words: str) -> None:
        self._peer_asks(who)
        self._peer_publishes(publisher, *words)
        self._peer_is_served(who, *words)

    def _peer_is_answered(self, who: str) -> None:
        assert self.world.gets_header(self.peers[who])["md5sum"] == self.served["md5sum"]

    def _peer_gets_fields(self, who: str, *words: str) -> None:
        assert self.world.gets_header(self.peers[who]) == _given(words)

    def _peer_closes(self, who: str) -> None:
        self.peers[who].sock.close()

    def _peer_resets(self, who: str) -> None:
        self.peers[who].reset()

    def _peer_ends(self, who: str, *words: str) -> None:
        rest = self.world.ends(self.peers[who])
        assert not words or rest == self._bytes(words)

    def _peer_has_nothing(self, who: str) -> None:
        self.peers[who].read()
        assert not self.peers[who].data

    def _peer_stays(self, who: str) -> None:
        self.peers[who].read()
        assert not self.peers[who].ended

    # --- control and the relay ---

    def _state(self, kind: str, *words: str) -> None:
        withdrawn = kind == "FactWithdrawn"
        message: Message = getattr(messages, kind)(*([words] if withdrawn else map(_value, words)))
        self.world.state(message, *([self.world.port] if kind == "NodePlaced" else []))

    def _hears(self, kind: str, *words: str) -> None:
        self._finds(lambda one: type(one).__name__ == kind and agrees(one, words, self.string))

    def _finds(self, wanted: Callable[[Any], bool]) -> None:
        found = self.world.until(lambda: next((one for one in self.world.told if wanted(one)), None))
        self.world.told.remove(found)

    def _quiet(self, kind: str) -> None:
        assert not [one for one in self.world.told if type(one).__name__ == kind]

    def _carried(self, resource: str, *expected: str) -> None:
        def reported() -> list[int]:
            told = (one for one in self.world.told if isinstance(one, messages.TrafficReported))
            rows = [row for one in told for row in one.rows if row.resource == resource]
            return [sum(row.messages for row in rows), sum(row.bytes for row in rows)]

        self.world.until(lambda: reported() == [*map(int, expected)])

    def _waiting(self, many: str) -> None:
        by_key = self.world.engine.waiting
        self.world.until(
            lambda: sum(len(peers) for hosts in by_key.values() for peers in hosts.values()) == int(many)
        )

    def _arriving(self, many: str) -> None:
        self.world.until(lambda: len(self.world.engine.incoming_connections) == int(many))

    def _clients(self, many: str) -> None:
        self.world.until(lambda: len(self.world.engine.clients) == int(many))

    def _connected(self, many: str) -> None:
        assert self.world.engine.ports.connected.total == int(many)

    def _service(self, _closes: str) -> None:
        self.world.service.close()

    def _held(self, many: str) -> None:
        self.world.until(lambda: self.world.held == int(many))

    def _pause(self, seconds: str) -> None:
        later = self.world.loop.clock() + float(seconds)
        self.world.until(lambda: self.world.loop.clock() > later)


def _given(words: tuple[str, ...]) -> dict[str, str]:
    return dict(word.split("=", 1) for word in words)


def _value(word: str) -> Any:
    return int(word) if word.isdigit() else {"yes": True, "no": False}.get(word, word)


def agrees(found: Any, words: tuple[str, ...], string: Callable[[str], bytes] = str.encode) -> bool:
    for word in words:
        same = "=" in word and ("~" not in word or word.index("=") < word.index("~"))
        name, text = word.split("=" if same else "~", 1)
        value = found
        for part in name.split("."):
            value = value[part] if isinstance(value, dict) else getattr(value, part)
        if isinstance(value, bytes):
            value, text = value.hex(), string(text)[4:].hex()
        elif isinstance(value, list):
            value = ",".join(map(str, value))
        if not (str(value) == text if same else text in str(value)):
            return False
    return True
