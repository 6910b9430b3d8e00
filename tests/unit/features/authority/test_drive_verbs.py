import json
from types import SimpleNamespace
from typing import Any

import pytest
import typer

from appliance.cli.output import say_json
from appliance.features.authority import verbs
from appliance.features.authority.requests import GroupState, GroupStates

ROWS = [GroupState(name, [], "", None, 5.0, None, []) for name in ("arm", "base")]


def appliance_of(rows: list[GroupState], *, as_json: bool) -> Any:
    def answer_or_exit(_request: Any) -> GroupStates:
        if as_json:
            say_json(GroupStates(rows))
            raise typer.Exit
        return GroupStates(rows)

    return SimpleNamespace(
        host_in_words=str,
        as_json=as_json,
        ask_or_exit=lambda _request: GroupStates(rows),
        answer_or_exit=answer_or_exit,
    )


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
        verbs.status.function(appliance_of(rows, as_json=as_json), group)
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
    appliance = appliance_of([row], as_json=False)
    appliance.host_in_words = lambda host: f"ocu ({host})"
    verbs.status.function(appliance, None)
    assert "/teleop on ocu (10.0.0.5) fell silent after a motion" in capsys.readouterr().out
