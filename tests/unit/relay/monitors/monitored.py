import struct
from typing import Any, ClassVar
from unittest import mock

from appliance.channel.messages import (
    MonitorEvent,
    MonitorsCounted,
    MonitorsReported,
    OwnPublished,
    SpecificationsRefused,
    SpecificationsTaken,
)
from roswire.tcpros import encode_frame, encode_header
from tests.support.stated import stated
from tests.unit.relay.dialogue import Dialogue, agrees
from tests.unit.relay.world import ASK, HEADER, Peer, World

STRING_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"
SET_BOOL_MD5 = "09fb03525b03e7ea1fd3992bafd87e16"
TYPED = HEADER | {"md5sum": STRING_MD5}
WANTED = ASK | {"md5sum": STRING_MD5}

GUARD = """
guard() {
    int seen = 0;
    event said(std::string text) /chatter std_msgs/String '{data:text}' {
        seen = seen + 1;
        if (text == "bad") { ROS_WARN("no such word"); return; }
        if (text == "one") text = "two";
        if (text == "long") text = "a longer text";
        if (text == "count") text = std::to_string(seen);
        if (text == "loop") { while (true) { seen = seen; } }
    }
}
"""
BEGINNING = GUARD.replace("guard()", "begin guard()")
"""Like `GUARD`, but it does not hold its topics when its state is lost."""
SAFE = 'safe std_msgs/String {data:"stop"} on /chatter every 1s; int seen'
STOPPING = GUARD.strip().replace("int seen", SAFE)


def string(text: str) -> bytes:
    data = text.encode()
    return encode_frame(struct.pack("<I", len(data)) + data)


def data_of(peer: Peer) -> bytes:
    peer.read()
    return bytes(peer.data)


COSTLY = """a() { int n; event e(std::string s) /chatter std_msgs/String '{data:s}' {
    for (int i = 0; i < s.size(); i++) { if (s[i] == 'y') n += i; } } }"""


class Monitored(World):
    def load(self, *texts: str, revision: int = 1, restarted: bool = False, **enabled: bool) -> Any:
        files = [(f"{number}.rv", text) for number, text in enumerate(texts)]
        self.state(stated(revision, files, {}, enabled, restarted))
        return self.until(
            lambda: self.taken(SpecificationsTaken, revision) or self.taken(SpecificationsRefused, revision)
        )

    def taken(self, kind: type[Any], revision: int) -> Any:
        for message in self.told:
            if isinstance(message, kind) and message.revision == revision:
                self.told.remove(message)
                return message
        return None

    def event(self, kind: str, **fields: Any) -> MonitorEvent:
        def find() -> MonitorEvent | None:
            for message in self.told:
                if isinstance(message, MonitorsReported):
                    for event in message.events:
                        if event.kind == kind and all(getattr(event, k) == v for k, v in fields.items()):
                            message.events.remove(event)
                            return event
            return None

        monitor_event: MonitorEvent = self.until(find)
        return monitor_event

    def typed(self) -> tuple[Peer, Peer]:
        publisher = self.upstream(TYPED)
        subscriber = self.connect(encode_header(WANTED))
        assert self.gets_header(subscriber) == TYPED
        return publisher, subscriber


LATCH = """
gate() {
    bool open = false;
    event ask(bool wish) service /mode std_srvs/SetBool request '{data:wish}' {
        if (open) { ROS_WARN("it is open"); return; }
        open = wish;
    }
}
"""
OTHER = "other() { event e() /elsewhere std_msgs/String '{}' { } }"
SPECIFICATIONS = {
    "GUARD": GUARD.strip(),
    "BEGINNING": BEGINNING.strip(),
    "STOPPING": STOPPING,
    "LATCH": LATCH,
    "OTHER": OTHER,
    "OTHER-HELD": "hold " + OTHER.replace("{ }", "{ return; }"),
    "ELSEWHERE": GUARD.replace("guard", "other").replace("/chatter", "/elsewhere"),
    "COSTLY": COSTLY,
    "QUADRATIC": """a() { int n = 0; event e(std::string s) /chatter std_msgs/String '{data:s}' {
        for (int i = 0; i < s.size(); i++) { for (int j = 0; j < 100; j++) { n = (n + i * j) % 1000; } } } }""",
    "IN-PLACE": "a() { event e(std::string s) /chatter std_msgs/String '{data:s}' { s[0] = 'X'; s[1] = 'Y'; } }",
    "LONGER": "b() { event e(std::string s) /chatter std_msgs/String '{data:s}' { s += \"more\"; } }",
    "LAST": "c() { event e(std::string s) /chatter std_msgs/String '{data:s}' { return; } }",
    "AGAIN": """again(std::string name) {
        event said(std::string name) /chatter std_msgs/String '{data:name}' { }
        pattern: globally: said causes said within 50ms
        @violation { ROS_ERROR("%s is late", name.c_str()); __RESET; }
    }""",
    "ECHO": """s() { std_msgs::String said; event e(std::string t) /chatter std_msgs/String '{data:t}' {
        said.data = t; PUBLISH(/alarm, std_msgs/String, said); } event tick() every 10ms { ROS_INFO("tick"); } }""",
    "DEADLINE": """s() { std_msgs::String said; warn() { said.data = "late"; PUBLISH(/alarm, std_msgs/String, said); }
        event e() /chatter std_msgs/String '{}' { } event done() /alarm std_msgs/String '{}' { }
        pattern: globally: e causes done within 10ms enforced by warn @violation { } }""",
    "SERVICE": """s() { event ask(bool on) service /mode std_srvs/SetBool request '{data:on}' { if (on) { return; } }
        event told(std::string m) service /mode std_srvs/SetBool response '{message:m}' { m = "changed"; } }""",
    "BUTTON": """latch() { event press() /chatter std_msgs/String '{}' { }
        fsm : start [ press -> pressed ] pressed [ press -> pressed ] @pressed { ROS_ERROR("pressed"); } }""",
    "nonsense": "nonsense",
}


class MonitoredDialogue(Dialogue):
    served: ClassVar = {"callerid": "/talker", "type": "std_srvs/SetBool", "md5sum": SET_BOOL_MD5}
    asked = WANTED
    published = TYPED
    world: Monitored

    def __init__(self, world: Monitored) -> None:
        super().__init__(world)
        self._revision = 0
        self._answer: Any = None

    def string(self, word: str) -> bytes:
        return string(word)

    def _load(self, *words: str) -> None:
        enabled = {word.removesuffix("=off"): False for word in words if word.endswith("=off")}
        shadows = tuple(word.removeprefix("shadow=") for word in words if word.startswith("shadow="))
        texts = [_text(word) for word in words if word != "restarted" and not word.endswith("=off")]
        texts = [text for text in texts if not text.startswith("shadow=")]
        self._revision += 1
        files = [(f"{number}.rv", text) for number, text in enumerate(texts)]
        self.world.state(stated(self._revision, files, {}, enabled, "restarted" in words, shadows=shadows))
        kinds = (SpecificationsTaken, SpecificationsRefused)
        self._answer = self.world.until(
            lambda: next(filter(None, (self.world.taken(kind, self._revision) for kind in kinds)), None)
        )

    def _taken(self, *words: str) -> None:
        assert isinstance(self._answer, SpecificationsTaken)
        assert agrees(self._answer, words), self._answer

    def _refused(self, *words: str) -> None:
        assert isinstance(self._answer, SpecificationsRefused)
        assert agrees(self._answer, words), self._answer

    def _event(self, *words: str) -> None:
        kind, fields = words[0], words[1:]

        def find() -> bool:
            for report in (one for one in self.world.told if isinstance(one, MonitorsReported)):
                for event in report.events:
                    if event.kind == kind and agrees(event, fields, self.string):
                        report.events.remove(event)
                        return True
            return False

        self.world.until(find)

    def _counts(self, name: str, *words: str) -> None:
        self.world.engine.interceptor.observations.tell_counters()
        self.world.link.catch_up()
        self.world.until(lambda: any(isinstance(one, MonitorsCounted) for one in self.world.told))
        counted = [row for one in self.world.told if isinstance(one, MonitorsCounted) for row in one.rows]
        row = next(row for row in reversed(counted) if row.name == name)
        assert agrees(row, words), row

    def _appliance(self, _publishes: str, topic: str, word: str) -> None:
        self.world.state(OwnPublished(topic, self.string(word)[4:]))

    def _second(self, word: str) -> None:
        interceptor = self.world.engine.interceptor
        if word == "held":
            self._tick = mock.patch.object(interceptor, "tick", lambda: None)
            self._tick.start()
        else:
            assert word == "ends"
            self._tick.stop()
            interceptor.tick()

    def _kinds(self, *words: str) -> None:
        reports = [one for one in self.world.told if isinstance(one, MonitorsReported)]
        assert {event.kind for report in reports for event in report.events} <= set(words)


def _text(word: str) -> str:
    """Return a specification. `NAME|old|new` replaces text, and the prefix `hold:` lets it hold its topics."""
    name, *changes = word.removeprefix("hold:").split("|")
    text = SPECIFICATIONS.get(name, name)
    for old, new in zip(changes[::2], changes[1::2], strict=True):
        text = text.replace(old, new)
    return f"hold {text}" if word.startswith("hold:") else text
