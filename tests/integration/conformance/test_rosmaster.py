"""A plain ROS master and the appliance give the same answers to the calls in `conversations/rosmaster.txt`.

`tests/unit/master/test_conversations.py` compares RVMaster's answers with the text.
"""

import math
import re
from pathlib import Path
from typing import Any
from xmlrpc.client import Binary, DateTime

import pytest

from tests.integration.conformance.side_by_side import TESTER, Api, BothMasters, ServiceApi, differences
from tests.support.conversation import conversations_of
from tests.support.conversation_calls import PORTS, call_of

_TEXT = Path(__file__).parents[2] / "unit" / "master" / "conversations" / "rosmaster.txt"
_CONVERSATIONS = conversations_of(_TEXT.read_text(encoding="utf-8")).conversations
VALUES: list[Any] = [
    0, 1024, 2**31 - 1, -(2**31), True, False, "", "x", "hello world", "ünïcode & <xml> ]]>", "\t two\nlines ",
    0.0, -0.0, math.pi, 3.4028235e38, -1e-300, 1e300, math.inf, -math.inf, math.nan, [], [1, 2, 3], ["a", "b"],
    [0.0, -4.5], [1, "a", math.pi, False], [[1, 2], ["a"], []], {}, {"a": 2, "b": 4}, {"a": {"b": {"c": "d"}}},
    {"list": [{"x": 1}, {"y": [2]}]}, {"z": 1, "a": 2}, Binary(b""), Binary(bytes(range(256))),
    DateTime("20051206T12:13:14"), [Binary(b"x"), DateTime("14921206T12:13:14")],
]  # fmt: skip
_URI = re.compile(r"(http|rosrpc)://127\.0\.0\.1:(\d+)/?")


def of_fake_nodes(name: Any, value: Any) -> Any:
    match = _URI.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return value
    port = int(match[2])
    return ServiceApi(port) if match[1] == "rosrpc" else Api(str(name).rpartition("/")[2], port - PORTS)


@pytest.mark.parametrize("title", _CONVERSATIONS)
def test_answers_are_those_of_rosmaster(both: BothMasters, title: str) -> None:
    for line in filter(str.strip, _CONVERSATIONS[title].splitlines()):
        if line.startswith(" "):
            continue
        call = call_of(line)
        name, *_ = [*call.params, ""]
        answers = both.call(call.method, *(of_fake_nodes(name, param) for param in call.params))
        if call.method == "system.multicall":
            assert answers.plain == answers.appliance
        else:
            assert differences(answers) == [], line
        assert differences(both.call("getSystemState", TESTER)) == [], f"the state after {line}"


@pytest.mark.parametrize("value", VALUES, ids=lambda value: f"{type(value).__name__}-{VALUES.index(value)}")
def test_every_kind_of_value_is_kept_as_by_rosmaster(both: BothMasters, value: Any) -> None:
    for step in (("setParam", "/kept/value", value), ("getParam", "/kept/value"), ("getParam", "/")):
        assert differences(both.call(step[0], TESTER, *step[1:])) == [], step
