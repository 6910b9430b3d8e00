import pytest

from appliance.features.policy_tools.audit_only import EnforceError, enforced_text
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.sections import DECIDERS

HEAD = "# a policy\n[Options]\ntell = rule\n"
TAIL = "\n[Nodes]\n/a = 10.0.0.1\n"
SECTIONS = [decider.name for decider in DECIDERS]


def lenient(text: str) -> set[str]:
    policy = compile_policy(text, file="p.ini")
    return {decider.name for decider in DECIDERS if policy.audit_only(decider.categories[0])}


@pytest.mark.parametrize("section", SECTIONS)
@pytest.mark.parametrize("line", ["audit-only = all  # for now", "audit-only = " + ", ".join(SECTIONS)])
@pytest.mark.parametrize("head", [HEAD, HEAD.lower(), HEAD.upper()], ids=["plain", "lower", "upper"])
def test_each_section_is_enforced_alone_and_the_others_stay(head: str, line: str, section: str) -> None:
    head = head.replace("TELL = RULE", "tell = rule")
    change = enforced_text(f"{head}{line}{TAIL}", [section.lower()])
    assert change.sections == (section,)
    assert lenient(change.text) == {*SECTIONS} - {section}
    assert change.text.startswith(head) and change.text.endswith(TAIL)
    assert ("# for now" in change.text) == ("#" in line)


def test_all_sections_are_enforced_without_the_line() -> None:
    change = enforced_text(f"{HEAD}audit-only = [Nodes] publishers{TAIL}")
    assert change.sections == ("Nodes", "Publishers")
    assert change.text == f"{HEAD.rstrip()}{TAIL}"


@pytest.mark.parametrize(
    ("options", "sections", "reason"),
    [
        ("", [], "no section of the policy is audit-only"),
        ("[Options]\naudit-only =\n", [], "no section of the policy is audit-only"),
        (
            "[Options]\naudit-only = Nodes\n",
            ["Publishers"],
            "Publishers: enforced already; audit-only are: Nodes",
        ),
        ("[Options]\naudit-only = all\n", ["Ports"], "'Ports' is not a section that decides"),
    ],
)
def test_a_section_that_cannot_be_enforced_is_an_error(
    options: str, sections: list[str], reason: str
) -> None:
    with pytest.raises(EnforceError) as caught:
        enforced_text(f"{options}[Nodes]\n/a = 10.0.0.1\n", sections)
    assert reason in str(caught.value)
