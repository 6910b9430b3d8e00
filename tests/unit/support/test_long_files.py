from tests.support.long_files import LONG, is_left_out, waits
from tests.support.sources import ROOT


def test_every_long_file_exists() -> None:
    assert [name for name in LONG if not (ROOT / name).is_file()] == []


def test_rules_on_the_source_run_with_make_check() -> None:
    """They are slow, but a commit that passes `make check` must not fail in CI because of a word in a comment."""
    assert waits("tests/unit/audit/log/test_log.py")
    assert not waits("tests/unit/test_source_rules.py")
    assert "tests/unit/test_source_rules.py" in LONG


def test_a_long_file_with_missing_rows_to_name_is_collected() -> None:
    complete = ROOT / "rosmop/tests/logics/test_catalogue.py"
    assert waits("rosmop/tests/logics/test_catalogue.py") and not is_left_out(complete)
    assert is_left_out(ROOT / "tests/unit/audit/log/test_log.py")


def test_make_check_leaves_out_the_long_files() -> None:
    [recipe] = [line for line in (ROOT / "Makefile").read_text().splitlines() if "--quick" in line]
    assert "$(DETERMINISTIC)" in recipe
