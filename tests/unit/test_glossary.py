import re
from collections import defaultdict
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
NOT_TERMS = {"next", "bridged", "holds"}  # the end of a page; a word of hypervisors; a form of `hold`


def test_the_terms_have_each_bold_word_of_their_page_and_of_two_others() -> None:
    pages = defaultdict(set)
    for page in DOCS.rglob("*.md"):
        for term in re.findall(r"\*\*([A-Za-z][A-Za-z -]{2,30})\*\*", page.read_text()):
            pages[term.lower()].add(page.name)
    terms = {term for term, names in pages.items() if len(names) > 1 or "glossary.md" in names}
    assert len(terms & {row.lower() for row in rows()}) > 15
    assert terms - {row.lower() for row in rows()} - NOT_TERMS == set()


def test_the_glossary_is_in_order() -> None:
    assert rows() == sorted(rows(), key=str.lower)


def rows() -> list[str]:
    terms = (DOCS / "reference" / "glossary.md").read_text().partition("\n## Terms\n")[2]
    return re.findall(r"^\| ([^|]+) \|", terms, re.MULTILINE)[1:]
