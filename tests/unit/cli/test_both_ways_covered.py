from pathlib import Path

from tests.support.command import commands
from tests.support.rows import require_rows

COMPARISON = Path(__file__).parents[2] / "integration" / "cli" / "test_both_ways.py"
# These verbs are tested over REST elsewhere, with their preconditions (a recording, a host's key, a pair); `limits` has
# numbers that change, a report has the time, and `audit acknowledge`, `adopt`, `release` and `fleet take` are refused
# over REST. The last three have options with these names that do not select the appliance.
ELSEWHERE = {
    "monitor replay", "record messages", "record fetch", "host add", "host kit", "policy check", "monitor diff",
    "standby status", "standby switch", "limits", "door add", "audit acknowledge", "adopt", "release",
    "fleet take",
    "report interventions", "up", "selftest", "protect",
}  # fmt: skip


def test_every_verb_of_a_running_appliance_is_covered() -> None:
    options = {
        name: {opt for parameter in verb.params for opt in parameter.opts} for name, verb in commands()
    }
    both = {name for name, known in options.items() if {"--state", "--api"} <= known}
    here, transcript = COMPARISON.read_text(), COMPARISON.with_name("both_ways.txt").read_text()
    missing = {
        name
        for name in both
        if ", ".join(f'"{word}"' for word in name.split()) not in here and f"$ rosrv {name}" not in transcript
    }
    compared = f"tests/integration/cli/{COMPARISON.name}, or to ELSEWHERE here with the reason"
    require_rows(missing, ELSEWHERE & missing, compared)
    require_rows(both | ELSEWHERE, both, "ELSEWHERE")
