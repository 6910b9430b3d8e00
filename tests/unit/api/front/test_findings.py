from appliance.api.front.problems import refusal
from appliance.channel.answers.monitor_answers import findings_of


def test_findings_without_a_position_stay_in_the_detail() -> None:
    problem = refusal(
        "refused", ["a would also be removed: it is in the same file", "a: b.rv:1:2: error: odd: 1:2"]
    )
    assert problem.findings is not None
    assert [(one.file, one.line, one.text) for one in problem.findings] == [("a: b.rv", 1, "odd: 1:2")]
    assert "would also be removed" in problem.detail
    assert findings_of(["nonsense", "a:b:c: error: x"]) == []
