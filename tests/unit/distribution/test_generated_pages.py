import pytest

from distribution.generated_pages import PAGES, generate, present


@pytest.mark.complete
@pytest.mark.parametrize("page", PAGES)
def test_a_generated_page_matches_the_program(page: str) -> None:
    is_current = present(page) == generate(page)
    assert is_current, f"{page} is out of date: run make pages"
