from pathlib import Path

_SECTIONS = (
    Path(__file__).with_name("mistakes.txt").read_text(encoding="utf-8").removeprefix("# ").split("\n\n# ")
)


def mistakes(title: str) -> list[tuple[str, ...]]:
    rows = dict(section.split("\n", 1) for section in _SECTIONS)[title].rstrip("\n").split("\n")
    plain = (row.encode("latin-1").decode("unicode_escape") for row in rows)
    return [tuple(row.split(" => ")) for row in plain]
