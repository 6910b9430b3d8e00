import pytest

from appliance.channel.answers.monitor_answers import Monitors
from appliance.features.monitor_tools.monitor_judgement import Compiler
from tests.support.answers import example

A = "a() { int n; event said() /chatter std_msgs/String '{}' { } ere: said said @match { } }"
TICK = "b() { event t() every 500ms { } event asked(bool on) service /set std_srvs/SetBool request '{data:on}' { } }"


def test_a_monitor_is_described() -> None:
    compiler = Compiler()
    a = compiler.describe(example(Monitors, revision=1, files={"a.rv": A, "b.rv": TICK}, definitions={}), "a")
    again = example(Monitors, revision=1)  # already compiled: the same revision is not compiled again
    b = compiler.describe(again, "b")
    (said,) = a.events
    assert (said.name, said.topic, said.type, said.part, said.every) == (
        "said", "/chatter", "std_msgs/String", None, None,
    )  # fmt: skip
    tick, asked = b.events
    assert (tick.topic, tick.every) == (None, 0.5)
    assert (asked.topic, asked.type, asked.part) == ("/set", "std_srvs/SetBool", "request")
    (matched,) = a.properties
    assert (matched.logic, matched.handled, matched.drawn) == ("ere", ["match"], True)
    assert str(compiler.picture(again, "a")).startswith("<svg ")
    assert compiler.picture(again, "b") is None
    with pytest.raises(KeyError):
        compiler.describe(again, "nobody")
