from collections.abc import Sequence
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer

from rosmop.form.findings import SpecificationError
from rosmop.learn.exercised import CoverageItem, add_counts, coverage, items_of
from rosmop.recordings.recording import RecordedFile
from rosmop.tests.acting import message
from rosmop.tests.learn.test_learner import START, Recorded
from roswire.standard import standard_definitions

TEXT = """gate() {
    int n = 0;
    bool big(int x) { return x > 5; }
    void unused() { n = 0; }
    event open(int x) /open std_msgs/Int32 '{data:x}' {
        if (big(x)) { n++; }
        else if (x == 1) { n--; }
        for (int i = 0; i < x; i++) n++;
    }
    event shut() /shut std_msgs/Int32 '{}' { if (n > 1000) return; }
    event other() /other std_msgs/Int32 '{}' { switch (n) { case 1: n = 2; break; default: n = 3; } }
    fsm: closed [ open -> opened, default closed ]
         opened [ shut -> closed, other -> broken, open -> opened ]
         broken [ default broken ]
    @opened { ROS_INFO("opened"); }
    @fail { ROS_WARN("fail"); }
}
"""


def counted(text: str, recordings: Sequence[Recorded]) -> dict[CoverageItem, int]:
    texts = {"gate.rv": text}
    items = items_of(texts)
    counts = [0] * len(items)
    for recording in recordings:
        counts = add_counts(counts, coverage(texts, standard_definitions(), recording))
    return dict(zip(items, counts, strict=True))


def recorded(name: str, messages: Sequence[tuple[str, int]]) -> Recorded:
    rows = tuple(
        (topic, START + place * 10**9, message("std_msgs/Int32", data=value))
        for place, (topic, value) in enumerate(messages)
    )
    return Recorded(name, rows, {topic: "std_msgs/Int32" for topic, _ in messages})


def exercised(*recordings: Recorded) -> dict[str, int]:
    found = counted(TEXT, recordings)
    return {f"{item.position.line} {item.kind} {item.what}": count for item, count in found.items()}


def test_each_thing_has_its_line_and_its_count() -> None:
    counts = exercised(recorded("a", [("/open", 7), ("/open", 0), ("/shut", 0)]))
    assert counts == {
        "3 function big": 2,
        "4 function unused": 0,
        "5 event open": 2,
        "6 branch if": 1,
        "7 branch if": 0,
        "7 branch else": 1,
        "8 branch loop": 7,
        "10 event shut": 1,
        "10 branch if": 0,
        "10 branch else": 1,
        "11 event other": 0,
        "11 branch case": 0,
        "12 state closed": 1,
        "12 transition closed: open -> opened": 1,
        "12 transition closed: default -> closed": 0,
        "13 state opened": 2,
        "13 transition opened: shut -> closed": 1,
        "13 transition opened: other -> broken": 0,
        "13 transition opened: open -> opened": 1,
        "14 state broken": 0,
        "14 transition broken: default -> broken": 0,
        "15 handler @opened": 2,
        "16 handler @fail": 0,
    }


def test_recordings_add_up() -> None:
    counts = exercised(
        recorded("a", [("/open", 1)]),
        recorded("b", [("/shut", 0), ("/open", 0), ("/other", 0), ("/shut", 0)]),
    )
    assert counts["12 transition closed: open -> opened"] == 2
    assert counts["12 transition closed: default -> closed"] == 1
    assert counts["14 transition broken: default -> broken"] == 1
    assert counts["7 branch if"] == 1
    assert counts["11 branch case"] == 1


def test_a_timeout_is_a_transition() -> None:
    text = """quiet() {
    event a() /a std_msgs/Int32 '{}' { }
    event b() /b std_msgs/Int32 '{}' { }
    tfsm: idle [ a -> busy, default idle ]
          busy [ a -> busy, timeout 2s -> late, default idle ]
          late [ default late, timeout 1h -> idle ]
    @late { ROS_WARN("late"); }
}
"""
    recording = recorded("a", [("/a", 0), ("/c", 0), ("/c", 0), ("/c", 0), ("/c", 0), ("/b", 0)])
    counts = {f"{item.kind} {item.what}": count for item, count in counted(text, [recording]).items()}
    assert counts["transition busy: timeout -> late"] == 1
    assert counts["transition late: default -> late"] == 1
    assert counts["transition late: timeout -> idle"] == 0
    assert counts["handler @late"] == 2


def test_a_given_time_is_that_of_a_timeout() -> None:
    text = """preset quiet 1 as quiet { after = 2s; }
quiet() given { time after = 4s; } {
    event a() /a std_msgs/Int32 '{}' { }
    tfsm: idle [ a -> busy, default idle ] busy [ timeout after -> late ] late [ default late ]
    @late { ROS_WARN("late"); }
}
"""
    recording = recorded("a", [("/a", 0), ("/c", 0), ("/c", 0), ("/c", 0), ("/a", 0)])
    counts = {f"{item.kind} {item.what}": count for item, count in counted(text, [recording]).items()}
    assert (counts["transition busy: timeout -> late"], counts["transition late: default -> late"]) == (1, 1)


def test_a_branch_by_caller_is_counted(tmp_path: Path) -> None:
    text = """gate() { event open(int x) /open std_msgs/Int32 '{data:x}' {
        if (caller(open) == "/pad") { ROS_INFO("by hand"); }
    } }"""
    with Writer(tmp_path / "a.bag") as bag:
        for number, caller in enumerate(("/pad", "/planner", None)):
            known = standard_definitions()
            text_and_sum = known.full_text("std_msgs/Int32"), known.md5sum("std_msgs/Int32")
            place = bag.add_connection(
                "/open", "std_msgs/msg/Int32", msgdef=text_and_sum[0], md5sum=text_and_sum[1], callerid=caller
            )
            bag.write(place, START + number, message("std_msgs/Int32"))
    found = coverage({"gate.rv": text}, standard_definitions(), RecordedFile(tmp_path / "a.bag", ["*"]))
    named = zip(items_of({"gate.rv": text}), found, strict=True)
    assert {item.what: count for item, count in named if item.kind == "branch"} == {"if": 1, "else": 2}


@pytest.mark.parametrize("wrong", ["e -> nowhere", "e => idle"])
def test_a_wrong_formula_is_refused_with_its_position(wrong: str) -> None:
    text = f"s() {{ event e() /e std_msgs/Int32 '{{}}' {{ }}\n fsm: idle [ {wrong} ]\n @idle {{ }} }}"
    with pytest.raises(SpecificationError) as caught:
        counted(text, [recorded("a", [("/e", 0)])])
    assert [finding.position.line for finding in caught.value.findings] == [2]


def test_an_error_is_that_of_the_text() -> None:
    with pytest.raises(SpecificationError) as caught:
        counted(TEXT.replace("n--", "m--"), [recorded("a", [])])
    assert str(caught.value.findings[0]).startswith("gate.rv:7:28: error: unknown variable `m`")


def test_slices_are_counted_together() -> None:
    text = """gate(int id) {
    event open(int id) /open std_msgs/Int32 '{data:id}' { }
    event shut(int id) /shut std_msgs/Int32 '{data:id}' { if (id == 2) ROS_INFO("2"); }
    fsm: closed [ open -> opened ] opened [ shut -> closed ]
    @fail { __RESET; }
}"""
    messages = [("/open", 1), ("/open", 2), ("/shut", 1), ("/shut", 2), ("/shut", 1)]
    found = counted(text, [recorded("a", messages)])
    counts = {f"{item.kind} {item.what}": count for item, count in found.items()}
    assert counts["event open"] == 2
    assert counts["branch if"] == 1
    assert counts["state opened"] == 2
    assert counts["state closed"] == 2
    assert counts["handler @fail"] == 1
