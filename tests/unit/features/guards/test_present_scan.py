import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import typer

from appliance.features.guards import suggest_verb
from appliance.features.guards.guard_answers import Suggestion, Suggestions
from appliance.features.guards.presets import PRESETS
from appliance.features.guards.suggest_verb import SCAN, WITHOUT, Scans, permitted_velocity
from rosmop.tests.acting import message
from rosmop.tool.last_messages import last_messages
from tests.support.bags import make_bag
from tests.support.memory_call import call_of

RAYS = 120
MS = 10**6


def scan(ahead: float, all_round: float | None = None) -> bytes:
    """Return a scan with a wall `ahead`, square to the way, and things at a distance `all_round`."""
    step = 2 * math.pi / RAYS
    angles = [-math.pi + step * place for place in range(RAYS)]
    ranges = [
        min(ahead / math.cos(angle) if math.cos(angle) > 0.05 else 25.0, all_round or 25.0)
        for angle in angles
    ]
    return message(
        SCAN, angle_min=-math.pi, angle_max=math.pi, angle_increment=step, range_min=0.05, range_max=30.0,
        ranges=ranges,
    )  # fmt: skip


def recorded(data: bytes, count: int = 6) -> Scans:
    return [((1000 + 100 * number) * MS, data) for number in range(count)]


def formula(distance: float, person: float, age: float = 0.15) -> float:
    """Return the velocity of the page's equation: v (a + r) + v² / 2b + p (a + r + v / b) + m = d."""
    reaction, braking, margin = 0.2 + 0.02, 1.0, 0.3
    half = braking * (age + reaction) + person
    left = distance - margin - person * (age + reaction)
    return 0.0 if left <= 0 else math.sqrt(half**2 + 2 * braking * left) - half


@pytest.mark.parametrize(("distance", "person"), [(1.0, 0.0), (2.0, 1.6)])
def test_the_preset_itself_says_what_a_scan_permits(distance: float, person: float) -> None:
    found = permitted_velocity("separation", {"person": str(person)}, recorded(scan(distance)))
    assert found == pytest.approx(formula(distance, person), abs=0.03)


def test_a_scan_in_the_other_direction_permits_the_same() -> None:
    angles = [math.pi - 2 * math.pi / RAYS * place for place in range(RAYS)]
    ranges = [1 / math.cos(angle) if math.cos(angle) > 0.05 else 25.0 for angle in angles]
    turned, standing = (
        permitted_velocity("separation", {"person": "0"}, recorded(message(
            SCAN, angle_min=math.pi, angle_increment=step, range_min=0.05, range_max=30.0, ranges=ranges,
        )))
        for step in (-2 * math.pi / RAYS, 0.0)
    )  # fmt: skip
    assert turned == pytest.approx(formula(1.0, 0), abs=0.03) and standing == 0


def test_a_scan_without_rays_permits_no_motion() -> None:
    data = message(SCAN, angle_min=-3.0, angle_max=3.0, angle_increment=0.1, range_max=9.0, ranges=[])
    assert permitted_velocity("separation", {}, recorded(data)) == 0


@pytest.mark.parametrize("preset", WITHOUT)
def test_the_shown_values_are_less_safe_by_the_preset(preset: str) -> None:
    assert all(PRESETS[preset].parameter(name).safe for name in WITHOUT[preset])
    assert PRESETS[preset].topics["by"] == (SCAN,)


Recorder = Callable[[], Any] | None


def recorder(bag: Path | None) -> Recorder:
    @contextmanager
    def spans(_appliance: Any, since: str, until: None, topics: Mapping[str, str]) -> Iterator[Any]:
        assert (since, until, topics) == ("5s", None, {"/scan": SCAN})
        if bag is None:
            raise typer.Exit(2)
        yield [("memory", bag, (0, 1 << 62))], "/rosrv"

    return lambda: spans


def suggest(
    monkeypatch: pytest.MonkeyPatch, found: Recorder, preset: str = "separation", *, as_json: bool = False
) -> None:
    monkeypatch.setattr(suggest_verb, "recorded_messages", found)
    topics = {"command": "/cmd_vel", "by": "/scan"}
    proposal = Suggestion(preset, preset, "Limits.", topics, {"silent": "0.5"}, {}, "rosrv guard new")
    call = call_of(lambda _request: Suggestions([proposal]), as_json=as_json)
    suggest_verb.suggest.function(call, with_scan=True)


def test_suggest_says_what_the_last_recorded_scan_permits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    near = scan(1.0)
    messages = [("/scan", SCAN, 1 + 0.1 * number, near) for number in range(12)]
    bag = make_bag(tmp_path / "a.bag", [*messages, ("/rear", SCAN, 9.0, b"")])
    found = last_messages([("a", bag, (0, 2 * 10**9))], {"/scan": SCAN, "/rear": SCAN}, 3)
    assert len(found["/scan"]) == 3 and found["/scan"][-1][0] <= 2 * 10**9 and not found["/rear"]
    suggest(monkeypatch, recorder(bag))
    permits, free = formula(1.0, 1.6), formula(1.0, 0)
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith("separation: the present scan of /scan permits ") and line.endswith(
        "below the standard"
    )
    assert [float(word) for word in line.split() if word[0].isdigit()] == pytest.approx(
        [permits, free], abs=0.03
    )


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "the last message of /scan is not a valid scan"),
        (None, "/scan has no scan in the last 5s of the flight recorder"),
    ],
)
def test_an_unknown_velocity_is_reported(
    content: bytes | None,
    why: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    topic, data = ("/scan", content) if content is not None else ("/other", scan(1.0))
    suggest(monkeypatch, recorder(make_bag(tmp_path / "a.bag", [(topic, SCAN, 1.0, data)])))
    assert f"separation: what it would permit is not known: {why}" in capsys.readouterr().out


def test_without_a_recording_no_velocity_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    suggest(monkeypatch, lambda: None)
    assert "is not known: this appliance has no flight recorder" in capsys.readouterr().out
    suggest(monkeypatch, recorder(None))
    assert "is not known: the flight recorder has no scan" in capsys.readouterr().out
    suggest(monkeypatch, recorder(None), as_json=True)
    assert '"unknown":' in capsys.readouterr().out.splitlines()[-1]
    suggest(monkeypatch, recorder(None), "deadman")
    assert capsys.readouterr().out.endswith("no proposed guard limits a velocity by a scan (separation)\n")
