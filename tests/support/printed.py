import json
import subprocess
from typing import Any

from tests.support.waiting import NoAnswerError


def rows_of(done: subprocess.CompletedProcess[str]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = [json.loads(line) for line in done.stdout.splitlines()]
    if done.returncode not in {0, 1} or any(row.keys() == {"error", "findings"} for row in rows):
        raise NoAnswerError(
            f"{' '.join(done.args)}: exit status {done.returncode}\n{done.stdout}\n{done.stderr}"
        )
    return rows


def row_of(done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    rows = rows_of(done)
    if not rows:
        raise NoAnswerError(f"{' '.join(done.args)}: exit status {done.returncode}\n{done.stderr}")
    (row,) = rows
    return row
