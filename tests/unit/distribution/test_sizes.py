from pathlib import Path

from distribution.sizes import LIMITS, lines_of_code, too_large, words


def test_a_limit_has_five_percent_of_play() -> None:
    limit = LIMITS["core"]
    assert too_large({"core": limit + limit // 20}) == []
    [line] = too_large({"core": limit + limit // 20 + 1})
    assert line.startswith(f"core has {limit + limit // 20 + 1:,} lines, and a limit of {limit:,}")


def test_lines_of_code_leave_out_blanks_comments_and_docstrings(tmp_path: Path) -> None:
    module = tmp_path / "module.py"
    module.write_text('"""A docstring\nof two lines."""\n\n# a comment\nx = (\n    1,\n)\n')
    assert lines_of_code(module) == 3


def test_a_page_that_moves_to_the_reference_is_cut_from_the_guides_only() -> None:
    moved = Path("docs/guards.md")
    assert 0 < len(moved.read_text().split()) < words()["guides"] < words()["pages"]
    assert words()["pages"] == sum(len(page.read_text().split()) for page in Path("docs").rglob("*.md"))


def test_the_guides_stay_short_and_the_index_begins_with_twelve_pages() -> None:
    """Further text is a row of the reference, or replaces words of a guide."""
    first = Path("docs/README.md").read_text().split("\n## ")[1]
    assert (words()["guides"] <= 40_000, first.count("\n| [")) == (True, 12)
