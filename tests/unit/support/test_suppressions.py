import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
FOLDERS = (
    "appliance", "rosmop", "roswire", "benchmarks", "distribution", "examples", "scripts", "tests", "lab",
)  # fmt: skip
LANGUAGES = {".py", ".js", ".mjs", ".sh", ".cpp", ".hpp", ".css", ""}
SUPPRESSION = re.compile(
    r"(?:#|//|/\*) *(?:(?:ruff: )?noqa(?:: ?[A-Z]+[0-9]+(?:, ?[A-Z]+[0-9]+)*)?|type: ignore(?:\[[^]]*\])?"
    r"|pragma: no cover|nosec|shellcheck disable=[A-Z0-9,]+|eslint-disable[\w/-]*(?: [a-z-]+)?|@ts-[a-z-]+|NOLINT\w*)"
)
NO_REASON = {"", "when needed", "needed", "for mypy", "for ruff", "a test"}


def test_each_suppression_has_its_reason() -> None:
    reasons = [
        (path, reason) for path in sources() for reason in reasons_in(path.read_text(encoding="utf-8"))
    ]
    assert [str(path) for path, reason in reasons if reason in NO_REASON] == []
    assert len(reasons) > 100


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("x = 1  # noqa", ""),
        ("x = 1  # noqa: S101, B008", ""),
        ("x = 1  # noqa: S101, B008  the names of variables", "the names of variables"),
        ("x = 1  # type: ignore[misc, index]", ""),
        ("x = 1  # type: ignore[misc]  # noqa: S101", ""),
        ("x = 1  # type: ignore[misc]  # noqa: S101 - as above", "as above"),
        ("# ruff: noqa: F403", ""),
        ("# shellcheck disable=SC2046", ""),
        ("// eslint-disable-next-line no-console", ""),
        ("/* eslint-disable */", ""),
    ],
)
def test_the_reason_is_what_follows(line: str, reason: str) -> None:
    assert list(reasons_in(line)) == [reason]


def reasons_in(text: str) -> Iterator[str]:
    for line in text.splitlines():
        _code, *after = SUPPRESSION.split(line)
        if after:
            yield after[-1].strip(" #*/-")


def sources() -> Iterator[Path]:
    for folder in FOLDERS:
        for path in (ROOT / folder).rglob("*"):
            ours = path != Path(__file__) and not {"vendor", "__pycache__"} & set(path.parts)
            if ours and path.suffix in LANGUAGES and path.is_file():
                yield path
