"""Read tables of tests: each line of `tables.txt` is a row, with columns between ` => ` and Python's escapes."""

from pathlib import Path

from tests.unit.transcripts import transcripts

_TABLES = transcripts(Path(__file__).with_name("tables.txt"))


def rows(title: str) -> list[tuple[str, ...]]:
    return [
        tuple(column.encode("ascii").decode("unicode_escape") for column in line.split(" => "))
        for line in _TABLES[title]
    ]
