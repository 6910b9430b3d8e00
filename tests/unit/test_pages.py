"""The pages for users: each is found from the README, and no link between them leads nowhere."""

import re
from pathlib import Path

import pytest

from appliance.channel.admin import OPERATIONS

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs").glob("*.md"))
WITH_LINKS = [
    *PAGES,
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")),
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_page_is_in_the_list_for_readers(page: Path) -> None:
    """Who begins at the README finds the list of pages, and in it every page."""
    assert "(docs/README.md)" in (ROOT / "README.md").read_text()
    assert page.name == "README.md" or f"({page.name})" in (ROOT / "docs" / "README.md").read_text()


@pytest.mark.parametrize("page", WITH_LINKS, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    """What a page links to, or names as a page, is there."""
    text = page.read_text()
    prose = re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)
    linked = [page.parent / link for link in re.findall(r"\]\((?!https?:|#)([^)#]+)", prose)]
    named = [ROOT / name for name in re.findall(r"\bdocs/[\w-]+\.md", text)]
    assert [place for place in linked + named if not place.exists()] == []


@pytest.mark.parametrize("page", ["docs/architecture.md", "CONTRIBUTING.md"])
def test_modules_that_are_named_are_there(page: str) -> None:
    """A newcomer who follows the page finds the file under the name it gives."""
    names = re.findall(r"\b(?:[a-z_]+/)+[a-z_]+\.(?:py|sh|js|rv|toml|yaml)\b", (ROOT / page).read_text())
    folders = (ROOT, ROOT / "appliance", ROOT / "appliance" / "api" / "console")
    assert [name for name in names if not any((folder / name).exists() for folder in folders)] == []


def test_every_operation_of_rest_is_on_its_page() -> None:
    """Each path that the command line calls, with a name in the place of each parameter."""
    text = (ROOT / "docs" / "rest.md").read_text()
    paths = {re.sub(r"{\w+}", r"[^/\\s?\"]+", one.path) for one in OPERATIONS if one.path}
    assert [path for path in paths if not re.search(rf"{path}(?![\w/])", text)] == []
