"""The results of long runs: `results.json`, which the evidence page prints.

A row is what the worlds of one preset showed: the digest of the preset's text, the first seed, and for each commit of
the rig the number of worlds that it ran. Only worlds of the text that is shipped count, and their seeds have no gap.
A file of the older form names one commit, one date and one first seed for all rows.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from appliance.features.guards.evidence import text_digest
from appliance.features.guards.presets import PRESETS
from lab.closed_loop.worlds import IN_PAIRS, PAIRS, Summary


@dataclass(frozen=True)
class Row:
    """The result of the worlds of one preset, or of pairs."""

    digest: str
    """The digest of the preset's text; for pairs, of all texts that take part."""
    first_seed: int
    worlds: int
    seconds: int
    """Simulated seconds."""
    closest: float | None
    """Metres."""
    violations: Mapping[str, int]
    """Worlds that broke a law, by law."""
    date: str
    commits: Mapping[str, int] = field(default_factory=dict)
    """The number of worlds that each commit of the rig ran."""
    acts: Mapping[str, int] = field(default_factory=dict)
    """The number of worlds by what happened to the guard (`ACTS`, or an empty text for nothing).

    Older runs did not count it.
    """
    honest: Mapping[str, int] = field(default_factory=dict)
    """Honest commands that were `sent` and that `passed`, where worlds count them."""

    @property
    def next_seed(self) -> int:
        return self.first_seed + self.worlds

    def data(self) -> dict[str, Any]:
        return {
            **vars(self),
            "violations": dict(self.violations),
            "commits": dict(self.commits),
            "acts": dict(self.acts),
            "honest": dict(self.honest),
        }


Rows = Mapping[str, Row]


def present_digests() -> dict[str, str]:
    """Return the digests of the texts that are shipped, and of the texts of pairs together."""
    digests = {name: text_digest(preset.text) for name, preset in PRESETS.items()}
    return {**digests, PAIRS: _of_pairs(digests)}


def _of_pairs(digests: Mapping[str, str]) -> str:
    """Return the digest of all texts that take part in pairs, or an empty text if one is not known."""
    if not digests.keys() >= IN_PAIRS:
        return ""
    return text_digest(" ".join(f"{name} {digests[name]}" for name in sorted(IN_PAIRS)))


def rows_of(summaries: Mapping[str, Summary], firsts: Mapping[str, int], commit: str, date: str) -> Rows:
    digests = present_digests()
    return {
        name: Row(
            digests[name],
            firsts[name],
            summary.worlds,
            round(summary.seconds),
            round(summary.clearance, 4) if summary.clearance < float("inf") else None,
            dict(summary.violations),
            date,
            {commit: summary.worlds},
            dict(summary.acts),
            dict(summary.honest),
        )
        for name, summary in summaries.items()
    }


def parse_rows(run: Mapping[str, Any]) -> Rows:
    """Return the rows of a file, also of one that names one commit for all of them."""
    if "rows" in run:
        return {name: Row(**row) for name, row in run["rows"].items()}
    rows = {**run["presets"], **({PAIRS: run[PAIRS]} if run[PAIRS] else {})}
    digests = {name: row["digest"] for name, row in run["presets"].items()}
    found: dict[str, Row] = {}
    for name, row in rows.items():
        common = {"first_seed": run["first_seed"], "date": run["date"], "digest": _of_pairs(digests)}
        fields = {**common, **{key: value for key, value in row.items() if key != "commit"}}
        found[name] = Row(**fields, commits={row.get("commit", run["commit"]): row["worlds"]})
    return found


def as_data(rows: Rows) -> dict[str, Any]:
    return {"rows": {name: row.data() for name, row in rows.items()}}


def join_runs(runs: Sequence[Rows], digests: Mapping[str, str]) -> tuple[Rows, list[str]]:
    """Return the sums of the runs, and for each row that is left out why: its worlds ran another text.

    Raises:
        ValueError: The seeds of a row do not follow those of the row before it.
    """
    sums: dict[str, Row] = {}
    left_out: list[str] = []
    for run in sorted(runs, key=lambda rows: min((row.first_seed for row in rows.values()), default=0)):
        for name, row in run.items():
            if row.digest != digests.get(name):
                left_out.append(
                    f"{name}: {row.worlds} worlds from seed {row.first_seed} ran another text than the present one"
                )
            else:
                sums[name] = _sum(name, sums[name], row) if name in sums else row
    return sums, left_out


def _sum(name: str, one: Row, other: Row) -> Row:
    if other.first_seed != one.next_seed:
        raise ValueError(
            f"a run of {name} begins with seed {other.first_seed}; the seed that follows is {one.next_seed}"
        )
    near = [row.closest for row in (one, other) if row.closest is not None]
    return replace(
        one,
        worlds=one.worlds + other.worlds,
        seconds=one.seconds + other.seconds,
        closest=min(near, default=None),
        violations=_add(one.violations, other.violations),
        date=max(one.date, other.date),
        commits=_add(one.commits, other.commits),
        acts=_add(one.acts, other.acts),
        honest=_add(one.honest, other.honest),
    )


def continue_rows(rows: Rows, run: Rows) -> Rows:
    """Return `rows` with the worlds of a later run; a row of another text is replaced.

    Raises:
        ValueError: The seeds of a row do not follow those of the row before it.
    """
    same = {name for name, row in run.items() if name in rows and rows[name].digest == row.digest}
    return {
        **rows,
        **{name: _sum(name, rows[name], row) if name in same else row for name, row in run.items()},
    }


def _add(one: Mapping[str, int], other: Mapping[str, int]) -> dict[str, int]:
    counts = Counter(one)
    counts.update(other)
    return dict(counts)


def correct_rows(rows: Rows, again: Rows) -> Rows:
    """Return `rows` with the rows of `again`, which ran the same worlds later, after a correction of the rig.

    Raises:
        ValueError: A row of `again` has other worlds.
    """
    for name, row in again.items():
        before = rows.get(name)
        if before is None or _same_worlds(before) != _same_worlds(row):
            raise ValueError(f"the later run of {name} has other worlds, another first seed or another text")
    return {**rows, **again}


def _same_worlds(row: Row) -> tuple[str, int, int]:
    return row.digest, row.first_seed, row.worlds
