"""Generate docs/reference/generated/guards-evidence.md.

It is made from the presets, from the table of proofs in docs/dev/assurance.md, from the last long run of the
simulated worlds (`lab/closed_loop/results.json`), and from the rows below.
"""

import json
from collections.abc import Iterator
from pathlib import Path

from appliance.features.guards.evidence import (
    COMMON_CAUSES,
    EVIDENCE,
    MEANING_OF_SUMS,
    NO_SAFETY_FUNCTION,
    RELAY_MS,
    stopping_time,
    text_digest,
)
from appliance.features.guards.presets import PRESETS
from distribution.checkout import BuildError
from lab.closed_loop.results import Row, Rows, parse_rows, present_digests
from lab.closed_loop.worlds import NOT_MODELLED, PAIRS, WORLDS, at_most

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "lab/closed_loop/results.json"
ASSURANCE = ROOT / "docs/dev/assurance.md"
_USUAL_TEST = "test_a_guard_does_what_its_page_says"

_HEAD = """\
# Evidence about guards

{claim}

- **Followed, not claimed**: edition and clause of each standard whose subject a preset follows in part; for vehicles,
  ISO 3691-4 comes first. All are *unchecked*: the authors of this page had no access to the texts of ISO and IEC
  standards. The numbers come from public tables of contents and articles, or from memory. Later editions, such as
  ISO 3691-4:2023, ISO 13849-1:2023, ISO 13855:2024 and ISO 10218:2025, may have others.
- **Proved** means that for every message of up to 512 KiB and every state the compiled code of the event does what its
  text says ([the proofs](../../dev/assurance.md#the-code-of-an-event)). Whether the text keeps the promise is not
  proved. Timers (`tick`) are not proved for any preset, and the `tick` of a `deadman` is the guard: it is tested and
  simulated.
- **Simulated** means random [worlds](../../dev/assurance.md#guards-in-simulated-worlds) with a robot, its sensors,
  persons and operators, within the assumptions that are listed for each preset. Timers are due on time there: the delay
  of a relay is measured (below), not simulated. In a part of the worlds an **act** happens to the guard: it is disabled
  and enabled in motion (*switch*), held and resumed (*hold*), gets bytes that are not a message (*cut*), or its process
  is replaced, with its state (*restart*) or without (*lost*). A row has the number of worlds with each act. A base that
  drove while its guard was disabled is judged from its next standstill on, if no stop could have prevented the harm.
  Where none of n worlds broke a law, at most 3/n of all such worlds do, with 95 % confidence.
- **Pairs** are worlds with two guards of different presets on one topic: {pairs}.
- **Tested in the engine** names tests of the preset's text. Without this row, `{usual}` tests it.
  With real nodes, the stops of the engine are tested by [a guard that is written for the
  test](../guards.md#when-the-base-is-stopped), not by each preset.
- **Digest**: the first 16 hexadecimal digits of the SHA-256 of the preset's text that this page describes.

## The time to stop

From the cause to the stop at the base. The guard's part follows from its text, with the values by default. The relay's
part has no guaranteed bound: of 1,000 stops on a busy machine the slowest took {relay} ms
([measured](../monitors.md#how-fast-a-guard-stops)), which are in the sum. Add the base's own reaction and the time in
which it brakes from its speed, and choose the values so that the sum is safe.

{sums}

| preset | it notices | silence | timer | sum |
|---|---|---|---|---|
"""


def page() -> str:
    """Return the page. Raises `BuildError` if a preset has no row here or no row of proofs."""
    for rows, where in (
        (EVIDENCE, "EVIDENCE of appliance/features/guards/evidence.py"),
        (_proofs(), str(ASSURANCE)),
    ):
        if missing := PRESETS.keys() - rows.keys():
            raise BuildError(f"add {', '.join(sorted(missing))} to {where}")
    return "\n".join(
        (
            _HEAD.format(
                claim=NO_SAFETY_FUNCTION,
                sums=MEANING_OF_SUMS,
                relay=RELAY_MS,
                usual=_USUAL_TEST,
                pairs=_simulated(PAIRS, _results()),
            )
            + "".join(_times()),
            *_presets(),
            *_common(),
        )
    )


def _common() -> Iterator[str]:
    yield "## Common causes\n\nThese make several guards fail together. The robot's own stop must not share them.\n"
    yield "| cause | effect | what remains |\n|---|---|---|"
    for row in COMMON_CAUSES:
        yield f"| {' | '.join(row)} |"
    yield ""


def _times() -> Iterator[str]:
    for name, preset in PRESETS.items():
        row = EVIDENCE[name]
        time = stopping_time(preset, {one.name: one.default for one in preset.parameters}, RELAY_MS)
        summed = "never by silence: it is off by default" if time.total is None else f"{time.total:.0f} ms"
        silence = f"`{row.silence}`, {time.silence:.0f} ms" if time.silence else "-"
        tick = f"{time.tick} ms" if time.tick else "-"
        yield f"| `{name}` | {row.notices} | {silence} | {tick} | {summed} |\n"


def _presets() -> Iterator[str]:
    proofs, results = _proofs(), _results()
    for name, preset in PRESETS.items():
        row = EVIDENCE[name]
        yield f"## {name}\n\n{preset.what}\n"
        yield "| | |\n|---|---|"
        yield f"| version, digest | {preset.version}, `{text_digest(preset.text)}` |"
        yield f"| followed, not claimed | {'; '.join(row.clauses)} |"
        values = ", ".join(f"`{one.name}` = {one.default} {one.unit}".strip() for one in preset.parameters)
        yield f"| defaults | {values or 'none'} |"
        yield f"| assumed | {'; '.join(row.assumed) or 'nothing beyond the common causes'} |"
        proved, open_ = proofs[name]
        yield f"| proved | {proved or 'nothing'}{open_ and f'; not {open_}'} |"
        yield f"| simulated | {_simulated(name, results)} |"
        if left := _left_out(name):
            yield f"| left out | {left} |"
        if row.unit != (_USUAL_TEST,):
            yield f"| tested in the engine | {_named(row.unit)} |"
        yield f"| fails without a notice | {'; '.join(row.fails)} |\n"


def _named(tests: tuple[str, ...]) -> str:
    return " ".join(f"`{test}`" for test in tests)


def _proofs() -> dict[str, tuple[str, str]]:
    table = (
        ASSURANCE.read_text(encoding="utf-8")
        .partition("| preset | proved | not proved |")[2]
        .partition("\n\n")[0]
    )
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    return {name.strip("`"): (proved, open_) for name, proved, open_ in rows}


def _results() -> Rows:
    return parse_rows(json.loads(RESULTS.read_text(encoding="utf-8"))) if RESULTS.exists() else {}


def _left_out(name: str) -> str:
    """Return the events that no world has, because the preset breaks a law at them."""
    by_reason: dict[str, list[str]] = {}
    for event, why in WORLDS[name].left_out().items() if name in WORLDS else ():
        by_reason.setdefault(why, []).append(f"*{event}*")
    return "; ".join(f"{', '.join(events)}: {why}" for why, events in by_reason.items())


def _simulated(name: str, results: Rows) -> str:
    if name in NOT_MODELLED:
        return f"no: {NOT_MODELLED[name]}"
    row = results.get(name)
    if row is None:
        return "no long run yet"
    if row.digest != present_digests()[name]:
        return f"not since its text changed ({row.date})"
    return f"{run_line(row)}{_acts(name, row) if name in WORLDS else ''}"


def _acts(name: str, row: Row) -> str:
    """Return in how many worlds each act happened, as far as it was counted."""
    counted = sum(row.acts.values())
    parts = ", ".join(f"*{act}* {row.acts.get(act, 0):,}" for act in WORLDS[name].acts())
    within = "" if counted == row.worlds else f" (counted in {counted:,} worlds)"
    return f"; {parts}{within}" if counted and parts else ""


def run_line(row: Row) -> str:
    """Return a row of the results in one line, with the worlds of each commit."""
    near = "" if row.closest is None else f", closest {row.closest * 100:.1f} cm"
    broken = sum(row.violations.values())
    bound = at_most(row.worlds).removesuffix(" with 95 % confidence")
    laws = f"{broken} broke a law" if broken else f"none broke a law ({bound})"
    if sent := row.honest.get("sent", 0):
        laws += f", {row.honest['passed']:,} of {sent:,} honest commands passed"
    counts = f"commit `{next(iter(row.commits))}`"
    if len(row.commits) > 1:
        counts = ", ".join(f"{worlds:,} of commit `{one}`" for one, worlds in row.commits.items())
    return f"{row.worlds:,} worlds from seed {row.first_seed}, {row.seconds:,} s, {laws}{near} ({row.date}, {counts})"
