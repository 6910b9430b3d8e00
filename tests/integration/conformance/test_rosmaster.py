"""A plain ROS master and the appliance give the same answers to the calls in `conversations/rosmaster.txt`.

`tests/unit/master/test_conversations.py` compares RVMaster's answers with the text.
"""

import re
from pathlib import Path
from typing import Any

import pytest

from tests.integration.conformance.side_by_side import TESTER, Api, BothMasters, ServiceApi, differences
from tests.support.conversation import conversations_of
from tests.support.conversation_calls import PORTS, call_of

_TEXT = Path(__file__).parents[2] / "unit" / "master" / "conversations" / "rosmaster.txt"
_CONVERSATIONS = conversations_of(_TEXT.read_text(encoding="utf-8")).conversations
_URI = re.compile(r"(http|rosrpc)://127\.0\.0\.1:(\d+)/?")


def of_fake_nodes(name: Any, value: Any) -> Any:
    """Return the URI of a fake node for each URI; the node belongs to the calling node."""
    match = _URI.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return value
    port = int(match[2])
    return ServiceApi(port) if match[1] == "rosrpc" else Api(str(name).rpartition("/")[2], port - PORTS)


@pytest.mark.parametrize("title", _CONVERSATIONS)
def test_answers_are_those_of_rosmaster(both: BothMasters, title: str) -> None:
    """Both masters answer every call alike, and have the same state after it."""
    for line in filter(str.strip, _CONVERSATIONS[title].splitlines()):
        if line.startswith(" "):
            continue
        call = call_of(line)
        name, *_ = [*call.params, ""]
        answers = both.call(call.method, *(of_fake_nodes(name, one) for one in call.params))
        if call.method == "system.multicall":
            assert answers.plain == answers.appliance
        else:
            assert differences(answers) == [], line
        assert differences(both.call("getSystemState", TESTER)) == [], f"the state after {line}"
