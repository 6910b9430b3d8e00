import json

import pytest
import typer

from appliance.features.authority import verbs
from appliance.features.authority.requests import GroupState, GroupStates
from tests.support.memory_call import call_of

ROWS = [GroupState(name, [], "", None, 5.0, None, []) for name in ("arm", "base")]


@pytest.mark.parametrize(
    ("rows", "group", "expected"),
    [
        (ROWS, None, (["arm", "base"], 0)),
        (ROWS, "base", (["base"], 0)),
        (ROWS, "bass", ([], 1)),
        ([], None, ([], 1)),
    ],
)
@pytest.mark.parametrize("as_json", [True, False])
def test_status_has_the_group_and_the_exit_status(
    capsys: pytest.CaptureFixture[str],
    rows: list[GroupState],
    group: str | None,
    expected: tuple[list[str], int],
    as_json: bool,
) -> None:
    ended = 0
    try:
        verbs.status.function(call_of(lambda _request: GroupStates(rows), as_json=as_json), group)
    except typer.Exit as end:
        ended = end.exit_code
    text = capsys.readouterr().out
    if as_json:
        found = [one["group"] for one in json.loads(text)["groups"]]
    else:
        found = [line.removesuffix(": free") for line in text.splitlines() if line.endswith(": free")]
    assert (found, ended) == expected


def test_the_reason_names_the_host_of_the_driver(capsys: pytest.CaptureFixture[str]) -> None:
    why = "/teleop on 10.0.0.5 fell silent after a motion: lower ranks wait until it lets go"
    row = GroupState("base", [], "10.0.0.5", 3.0, 0.0, None, [], ["a"], "/teleop", "lost", why)
    call = call_of(lambda _request: GroupStates([row]), names=lambda host: f"ocu ({host})")
    verbs.status.function(call, None)
    assert "/teleop on ocu (10.0.0.5) fell silent after a motion" in capsys.readouterr().out
