import re
from collections import defaultdict
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
NOT_TERMS = {"next", "bridged", "holds"}  # the end of a page; a word of hypervisors; a form of `hold`


def test_the_glossary_has_each_bold_term_of_two_pages() -> None:
    rows = re.findall(r"^\| ([^|]+) \|", (DOCS / "reference" / "glossary.md").read_text(), re.MULTILINE)
    pages = defaultdict(set)
    for page in DOCS.rglob("*.md"):
        for term in re.findall(r"\*\*([A-Za-z][A-Za-z -]{2,30})\*\*", page.read_text()):
            pages[term.lower()].add(page.name)
    terms = {term for term, names in pages.items() if len(names) > 1}
    assert len(terms & {row.lower() for row in rows}) > 5
    assert terms - {row.lower() for row in rows} - NOT_TERMS == set()


def test_the_glossary_is_in_order() -> None:
    rows = re.findall(r"^\| ([^|]+) \|", (DOCS / "reference" / "glossary.md").read_text(), re.MULTILINE)[2:]
    assert rows == sorted(rows, key=str.lower)
