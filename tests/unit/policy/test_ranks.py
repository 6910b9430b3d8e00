"""`rank` and `free` in `[Authority]`."""

import pytest

from appliance.policy.authority import AuthorityGroup
from appliance.policy.model import address_of
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import PolicyError

GROUP = "[Groups]\nweb = 10.0.0.2\n[Authority]\nbase = /cmd_vel\n"


def group_of(text: str) -> AuthorityGroup:
    return compile_policy(text, file="site.ini", robot=[address_of("10.9.9.9")]).authority["base"]


def errors_of(text: str) -> list[str]:
    with pytest.raises(PolicyError) as failed:
        compile_policy(text, file="site.ini")
    return [finding.text for finding in failed.value.findings if finding.severity == "error"]


@pytest.mark.parametrize(
    ("host", "node", "rank"),
    [
        ("10.0.0.1", "/pad", 0),
        ("10.9.9.9", "/joy", 0),
        ("10.9.9.9", "/other", None),
        ("10.0.0.2", "/pad", 1),
        ("10.0.0.1", "/planner", 2),
        ("10.0.0.9", "/planner", 2),
        ("10.0.0.1", "/other", 2),
        ("10.0.0.9", "/pad", None),
    ],
)
def test_the_rank_of_a_node(host: str, node: str, rank: int | None) -> None:
    """A node's own rank counts before that of its host."""
    text = "[Groups]\nweb = 10.0.0.2\nlan = 10.0.0.0/24\n[Authority]\nbase = /cmd_vel\n"
    text += "rank base = 10.0.0.1/pad robot/joy > web > lan/planner 10.0.0.1\n"
    policy = compile_policy(text, file="site.ini", robot=[address_of("10.9.9.9")])
    assert policy.authority["base"].rank(policy.atoms_of(address_of(host)), node) == rank


@pytest.mark.parametrize(("written", "seconds"), [("300ms", 0.3), ("2s", 2.0), ("0.5s", 0.5), ("100ms", 0.1)])
def test_the_time_until_a_group_is_free(written: str, seconds: float) -> None:
    """In milliseconds or seconds; 0.3 s without the line."""
    rank = "rank base = web > 10.0.0.1\n"
    assert group_of(GROUP + rank).free == 0.3
    assert group_of(GROUP + rank + f"free base = {written}\n").free == seconds


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (GROUP + "rank base = web\n", "name at least two ranks"),
        (GROUP + "rank base = web > > 10.0.0.1\n", "name at least two ranks"),
        (GROUP + "rank base = > web\n", "name at least two ranks"),
        (GROUP + "rank base = web > web\n", '"web" has two ranks'),
        (GROUP + "rank base = web > wep/joy\n", 'no group "wep"'),
        (GROUP + "rank base = web > web/joy//x\n", "is not the name of a node"),
        (
            GROUP + "rank base =" + " > ".join(f" 10.0.0.{one}" for one in range(17)) + "\n",
            "more than 16 ranks",
        ),
        (GROUP + "rank base = web > 10.0.0.1\ntake base = web\n", "either a rank or take"),
        (GROUP + "rank base = web > 10.0.0.1\nlease base = 5s\n", "either a rank or lease"),
        (GROUP + "rank base = web > 10.0.0.1\nfree base = 50ms\n", "give 100ms to 60s"),
        (GROUP + "rank base = web > 10.0.0.1\nfree base = fast\n", "give 100ms to 60s"),
        (GROUP.replace("/cmd_vel", "/cmd_vel /arm") + "rank base = web > 10.0.0.1\n", "so it has one topic"),
        (GROUP.replace("base =", "my-base =") + "rank my-base = web > 10.0.0.1\n", "letters, digits and _"),
    ],
)
def test_a_mistake_says_what_to_write(text: str, error: str) -> None:
    """Each at the check of the policy, before it is in force."""
    errors = errors_of(text)
    assert any(error in one for one in errors), errors


def test_free_needs_a_rank() -> None:
    """A line that would do nothing is an error."""
    assert any("rank base" in error for error in errors_of(GROUP + "take base = web\nfree base = 300ms\n"))
