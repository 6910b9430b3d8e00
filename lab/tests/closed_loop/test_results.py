from dataclasses import replace
from typing import Any

import pytest

from lab.closed_loop.results import (
    Row,
    as_data,
    continue_rows,
    correct_rows,
    join_runs,
    parse_rows,
    present_digests,
    rows_of,
)
from lab.closed_loop.worlds import PAIRS, WORLDS, Summary
from lab.guards_evidence_page import run_line

DIGESTS = {"rate": "r", "joints": "j"}


def row(seed: int, commit: str = "c1", digest: str = "r", worlds: int = 300) -> Row:
    broken, acts, honest = {"L1": 1}, {"": worlds - 1, "hold": 1}, {"sent": 8, "passed": 7}
    return Row(digest, seed, worlds, 9, seed / 1000, broken, "2026-11-28", {commit: worlds}, acts, honest)


def test_worlds_of_several_commits_are_added_and_counted_by_commit() -> None:
    runs = [{"rate": row(1600, "c2")}, {"rate": row(1000)}, {"rate": row(1300)}]
    rows, left_out = join_runs(runs, DIGESTS)
    commits, acts, honest = {"c1": 600, "c2": 300}, {"": 897, "hold": 3}, {"sent": 24, "passed": 21}
    added = Row("r", 1000, 900, 27, 1.0, {"L1": 3}, "2026-11-28", commits, acts, honest)
    assert rows == {"rate": added} and not left_out
    assert parse_rows(as_data(rows)) == rows
    line = "900 worlds from seed 1000, 27 s, {}, 21 of 24 honest commands passed, closest 100.0 cm"
    when = " (2026-11-28, 600 of commit `c1`, 300 of commit `c2`)"
    assert run_line(added) == line.format("3 broke a law") + when
    bound = "none broke a law (at most 0.33 %)"
    assert run_line(replace(added, violations={})) == line.format(bound) + when


@pytest.mark.parametrize("seed", [1299, 1301, 1000])
def test_a_run_whose_seeds_do_not_follow_is_rejected(seed: int) -> None:
    with pytest.raises(ValueError, match="rate begins with seed"):
        join_runs([{"rate": row(1000)}, {"rate": row(seed)}], DIGESTS)


def test_worlds_of_another_text_are_left_out_and_named() -> None:
    """After a text has changed, the row of its worlds begins again, and the other rows go on."""
    old = {"rate": row(1000), "joints": row(1000, digest="old")}
    new = {"rate": row(1300), "joints": row(1300, digest="j", commit="c2")}
    rows, left_out = join_runs([old, new], DIGESTS)
    assert rows["rate"].worlds == 600 and rows["joints"] == new["joints"]
    assert left_out == ["joints: 300 worlds from seed 1000 ran another text than the present one"]


def older_form(**presets: dict[str, Any]) -> dict[str, Any]:
    both: dict[str, Any] = {"worlds": 60, "seconds": 9, "closest": None, "violations": {}}
    rows = {name: {"digest": digest, **both} for name, digest in present_digests().items() if name in WORLDS}
    pairs = {**both, "commit": "c2"}
    return {"commit": "c1", "date": "d", "first_seed": 7, "presets": {**rows, **presets}, PAIRS: pairs}


def test_a_file_of_the_older_form_is_read() -> None:
    rows, left_out = join_runs([parse_rows(older_form())], present_digests())
    assert rows.keys() == {*WORLDS, PAIRS} and not left_out
    assert rows["rate"].commits == {"c1": 60} and rows[PAIRS].commits == {"c2": 60}
    assert rows[PAIRS].first_seed == 7


def test_pairs_of_another_text_are_left_out() -> None:
    run = older_form()
    run["presets"]["speed"]["digest"] = "old"
    rows, left_out = join_runs([parse_rows(run)], present_digests())
    assert "rate" in rows and not {"speed", PAIRS} & rows.keys() and len(left_out) == 2
    run["presets"] = {}
    assert join_runs([parse_rows(run)], present_digests())[0] == {}


def test_a_run_gives_a_row_for_each_preset_and_for_pairs() -> None:
    rows = rows_of(
        {"rate": Summary(5, 2.6), PAIRS: Summary(5, 1.0, 0.12345)}, {"rate": 3, PAIRS: 3}, "c1", "2026-11-28"
    )
    assert rows["rate"].digest == present_digests()["rate"] and rows["rate"].commits == {"c1": 5}
    assert rows["rate"].closest is None and rows["rate"].seconds == 3
    assert rows[PAIRS].closest == 0.1235 and rows[PAIRS].next_seed == 8
    assert join_runs([rows], present_digests()) == (rows, [])


def test_a_run_goes_on_where_the_rows_of_its_text_end() -> None:
    before = {"rate": row(1000), "joints": row(1000, digest="old"), "speed": row(1000)}
    rows = continue_rows(before, {"rate": row(1300, "c2"), "joints": row(7, digest="j")})
    assert (rows["rate"].first_seed, rows["rate"].worlds) == (1000, 600)
    assert rows["joints"] == row(7, digest="j") and rows["speed"] == before["speed"]
    with pytest.raises(ValueError, match="rate begins with seed"):
        continue_rows(before, {"rate": row(1301)})


def test_a_later_run_replaces_the_rows_of_the_same_worlds() -> None:
    run = {"rate": row(7), "joints": row(7)}
    later = replace(row(7, "c2"), violations={})
    assert correct_rows(run, {"rate": later}) == {**run, "rate": later}
    for other in (row(8), row(7, worlds=299), row(7, digest="x")):
        with pytest.raises(ValueError, match="other worlds"):
            correct_rows(run, {"rate": other})
    with pytest.raises(ValueError, match="other worlds"):
        correct_rows(run, {"sane": later})
