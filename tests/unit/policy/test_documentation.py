import re
from pathlib import Path

from appliance.policy.actions import VERBS
from appliance.policy.cases import run_cases
from appliance.policy.commands import COMMANDS
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.sections import NAMES
from tests.support.rows import require_rows

DOCS = Path(__file__).parents[3] / "docs"
PAGE = (DOCS / "policy.md").read_text(encoding="utf-8")
REFERENCE = (DOCS / "reference" / "policy-file.md").read_text(encoding="utf-8")


def block(language: str, number: int = 0) -> str:
    found: list[str] = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    return found[number]


def test_first_policy_of_the_page_loads() -> None:
    policy = compile_policy(block("ini"), file="docs/policy.md")
    assert {warning.line for warning in policy.warnings} == {4}


def test_cases_of_the_page_are_well_formed() -> None:
    assert len(run_cases(compile_policy(block("ini"), file="p.ini"), block("yaml"), "docs/policy.md")) == 5


def test_every_word_of_the_language_is_on_a_page() -> None:
    words = {*COMMANDS, *VERBS, *(f"[{name}]" for name in NAMES)}
    described = {word for word in words if f"`{word}`" in REFERENCE or f"--{word}" in PAGE}
    require_rows(words, described, "docs/reference/policy-file.md, in `backticks`")
