import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
FEATURES = Path("appliance") / "features"
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


def test_a_lease_is_of_two_appliances() -> None:
    """A holder's silence is *release after*, an operator's permission an *approval*; formats keep their names."""
    others = [*DOCS.glob("*.md"), *(DOCS / "reference").glob("*.md")]
    found = {
        page.name for page in others if re.search(r"\bleases?\b", prose(page.read_text()), re.IGNORECASE)
    }
    assert found == {"glossary.md", "metrics.md", "monitors-tutorial.md", "processes.md", "standby.md"}
    sources = [one for part in ("approvals", "authority") for one in (ROOT / FEATURES / part).glob("*.py")]
    assert len(sources) > 15
    names = {name for one in sources for name in re.findall(r"\w*lease\w*", one.read_text(), re.IGNORECASE)}
    assert {name for name in names if "release" not in name.lower()} == {
        "lease",
        "leases",
        "rosrv_approvals_leases",
    }


def prose(page: str) -> str:
    """Return the text of a page without its code."""
    return re.sub(r"^```.*?^```|^    .*?$|`[^`\n]*`", "", page, flags=re.MULTILINE | re.DOTALL)


def rows() -> list[str]:
    terms = (DOCS / "reference" / "glossary.md").read_text().partition("\n## Terms\n")[2]
    return re.findall(r"^\| ([^|]+) \|", terms, re.MULTILINE)[1:]
