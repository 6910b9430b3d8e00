import re
import subprocess

import pytest

from tests.support.printed import row_of, rows_of
from tests.support.sources import files_of_tests
from tests.support.waiting import NoAnswerError, eventually

STANDS_BY = '{"error":"this appliance stands by for a","findings":[]}\n'
FAILING_VERB = re.compile(r'"--json"[^()]*check=False')
READ_ITS_STATUS_TOO = {  # the exit status, or the number of lines, is what they test
    "test_takeover_check.py",
    "test_package.py",
    "test_cloud_init.py",
    "test_proof_test.py",
}


def done(output: str, status: int) -> "subprocess.CompletedProcess[str]":
    return subprocess.CompletedProcess(
        ["rosrv", "status", "--json"], status, output, "no appliance is running"
    )


def test_a_report_of_problems_is_an_answer() -> None:
    assert row_of(done('{"troubles":["disk full"]}\n', 1)) == {"troubles": ["disk full"]}
    assert rows_of(done("", 0)) == []


@pytest.mark.parametrize(
    ("output", "status"),
    [(STANDS_BY, 1), ("", 2), ("", 1)],
    ids=["stands by", "not running", "container gone"],
)
def test_an_error_counts_as_silence(output: str, status: int) -> None:
    with pytest.raises(NoAnswerError, match=re.escape(output.strip() or "no appliance is running")):
        row_of(done(output, status))


@pytest.mark.nightly
def test_waiting_goes_on_without_an_answer() -> None:
    answers = iter([done("", 2), done(STANDS_BY, 1), done('{"role":"active"}\n', 0)])
    assert eventually(lambda: row_of(next(answers))["role"], "it is active") == "active"
    with pytest.raises(AssertionError, match=r"it is active\nno answer: .*exit status 2"):
        eventually(lambda: row_of(done("", 2)), "it is active", seconds=0)


def test_no_test_decodes_an_error_as_an_answer() -> None:
    found = {
        path.name
        for path in files_of_tests()
        if path.parent.name != "support" and FAILING_VERB.search(path.read_text())
    }
    assert found == READ_ITS_STATUS_TOO
