import itertools
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, need_ros
from tests.support.rest import Rest
from tests.support.waiting import eventually

WORD = "zq7word"
MONITORS = """
drops() { event e(std::string text) /a std_msgs/String '{data:text}' { if (text.size() > 2) { return; } } }
changes() { event e(std::string &text) /b std_msgs/String '{data:text}' { text = text + "!"; } }
faults() { event e(std::string text) /c std_msgs/String '{data:text}' { std::string t = text.substr(100); } }
tells(std::string text) {
    creation event e(std::string text) /d std_msgs/String '{data:text}' { }
    event f(std::string text) /e std_msgs/String '{data:text}' { }
    ere: e f* @match { DROP; } @fail { __RESET; }
}
publishes() { event e(std::string text) /f std_msgs/String '{data:text}' {
    std_msgs::String s; s.data = text; PUBLISH(/g, std_msgs/String, s); } }
"""


@pytest.fixture
def appliance() -> Iterator[Appliance]:
    need_ros()
    settings = (
        "recorder: {enabled: true, memory: 16MiB, before: 5, after: 1, longest: 8, disk: 512MiB,"
        " triggers: [drop, change, verdict, fault]}\naudit: {reserve_bytes: 1MiB}\n"
    )
    with Appliance(
        settings=settings, monitors={"all": MONITORS}, options=("--api", "127.0.0.1:0")
    ) as appliance:
        yield appliance


def test_no_path_shows_contents_of_messages_to_a_viewer(appliance: Appliance, tmp_path: Path) -> None:
    tokens: dict[str, Rest] = {}
    for role in ("viewer", "operator", "investigator"):
        made = appliance.rosrv("token", "add", f"the-{role}", "--role", role, "--json").stdout
        tokens[role] = appliance.rest(json.loads(made)["token"])
    with RosSession(appliance.master_uri, tmp_path) as ros:
        for topic in "abcdefg":
            ros.listener("roscpp", f"/{topic}")
        for topic in "abcdef":
            ros.talker("roscpp", f"/{topic}", "--text", WORD)
        for event in (
            "message dropped",
            "message changed",
            "monitor fault",
            "monitor verdict",
            "monitor published",
        ):
            appliance.recorded("--event", event)
        appliance.rosrv("monitor", "enable", "drops", "tells", "--shadow")
        appliance.recorded("--event", "shadow observed")
        listed = eventually(
            lambda: tokens["viewer"].get("/v1/recordings").json["recordings"], appliance.story
        )
    named = {
        (one["event"], one["detail"].get("monitor")): one["id"] for one in appliance.audit("--limit", "10000")
    }
    values = {
        "name": ["drops", "changes", "faults", "tells", "publishes"], "recording_id": [listed[0]["id"]],
        "revision": ["1"], "record_id": [*named.values()],
    }  # fmt: skip
    places = {role: [*places_with(WORD, rest, values)] for role, rest in tokens.items()}
    assert places["viewer"] == []
    messages = {f"/v1/recordings/{listed[0]['id']}/{what}" for what in ("bag", "messages", "evidence")}
    assert {f"/v1/audit/{named['monitor verdict', 'tells']}", "/v1/audit"} <= {*places["operator"]} - messages
    assert not messages & {*places["operator"]}
    assert messages - {*places["investigator"]} <= {
        f"/v1/recordings/{listed[0]['id']}/evidence"
    }  # the text is packed
    assert WORD not in appliance.story()


def places_with(word: str, rest: Rest, values: dict[str, list[str]]) -> Iterator[str]:
    asked = {
        "/v1/audit": "?limit=500", "/v1/evidence": "?since=1h", "/v1/monitors": "?texts=true",
        "messages": "?at=1970-01-01", "/v1/audit/stream": "?after=1",
    }  # fmt: skip
    for path, methods in rest.get("/v1/openapi.json").json["paths"].items():
        if "get" not in methods or path == "/v1/messages":  # the picture's frames are for operators only
            continue
        needed = re.search(r"\{(\w+)", path)
        for value in values[needed[1]] if needed else [""]:
            place = re.sub(r"\{[^}]*\}", value, path)
            query = asked.get(path, asked.get(path.rpartition("/")[2], ""))
            if path.endswith(("/stream", "/live")):
                events = rest.events(place + query)
                body = json.dumps([*itertools.islice(events, 100 if query else 3)]).encode()
                events.close()
            else:
                body = rest.get(place + query).body
            if word.encode() in body:
                yield place
