"""Test the view Policy: edit, explain, test, load with commit-confirm, roll back; two engineers at once."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import expect

from tests.support.appliance import Appliance
from tests.system.console.conftest import CONFIG, POLICY
from tests.system.console.reader import Reader

TESTS = """\
cases:
  - host: 10.0.0.9
    node: /joystick
    allow: [publish /cmd_vel]
    deny: [publish /guarded]
"""


@pytest.fixture(scope="module")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    """Run an appliance whose policy has tests."""
    config = tmp_path_factory.mktemp("console") / "appliance.yaml"
    config.write_text(CONFIG)
    running = Appliance(policy=POLICY, options=("--config", str(config)))
    Path(f"{running.policy_file}.tests.yaml").write_text(TESTS)
    with running:
        yield running


def revision(appliance: Appliance) -> int:
    """Return the policy in force."""
    return int(appliance.rest().get("/v1/policy").json["revision"])


def test_an_error_is_shown_at_its_line_and_changes_nothing(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    """The error of a wrong line appears at the line while it is typed, with a mark in the margin; nothing is loaded."""
    before = revision(appliance)
    reader = opened()
    page = reader.go("policy")
    reader.write(POLICY.replace("[Subscribers]", "bogus\n[Subscribrs]"))
    finding = page.locator(".finding").first
    expect(finding).to_contain_text("9:1")
    expect(finding).to_contain_text("key = value")
    expect(page.locator(".finding").nth(1)).to_contain_text("did you mean Subscribers?")
    expect(page.locator(".cm-lint-marker-error")).to_have_count(2)
    finding.click()
    expect(page.locator(".cm-lineNumbers .cm-activeLineGutter")).to_have_text("9")
    assert revision(appliance) == before


def test_the_editor_has_exactly_the_typed_text(opened: Callable[..., Reader]) -> None:
    """After quick typing over several lines, undo and redo, the text is exactly what was typed."""
    reader = opened()
    page = reader.go("policy")
    first = reader.editor().inner_text()
    reader.editor().click()
    page.keyboard.press("Control+End")
    lines = "\n".join(f"# line {number} of a long remark, typed without a pause" for number in range(12))
    page.keyboard.type(lines)
    expect(reader.editor()).to_contain_text("# line 11 of a long remark, typed without a pause")
    page.get_by_role("tab", name="Diff").click()
    expect(page.locator(".diff-line.added")).to_have_count(12)
    page.get_by_role("button", name="Discard").click()
    expect(page.get_by_text("as in force")).to_be_visible()
    expect(reader.editor()).not_to_contain_text("of a long remark")
    assert reader.editor().inner_text() == first


def test_a_right_text_is_loaded_with_its_comment(appliance: Appliance, opened: Callable[..., Reader]) -> None:
    """A dry run shows the changes and the diff; loading makes a new revision with author and comment."""
    before = revision(appliance)
    reader = opened()
    page = reader.go("policy")
    reader.write(POLICY.replace("/guarded = 10.9.9.9 ", "/guarded = 10.9.9.8 "))
    page.get_by_role("button", name="Dry run").click()
    expect(page.get_by_text("It can be loaded")).to_be_visible()
    page.get_by_role("tab", name="Diff").click()
    expect(page.locator(".diff-line.added")).to_contain_text("10.9.9.8")
    page.get_by_role("button", name="Load", exact=True).click()
    dialog = page.get_by_role("dialog", name="Load this policy?")
    dialog.get_by_label("Comment").fill("ticket 812")
    dialog.get_by_role("button", name="Load the policy").click()
    expect(reader.toast(f"Revision {before + 1} is in force")).to_be_visible()
    expect(page.locator(".head-sub")).to_contain_text("ticket 812")
    assert revision(appliance) == before + 1
    assert appliance.rest().get("/v1/policy").json["who"] == "first"


def test_commit_confirm_keeps_or_rolls_back_a_policy(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    """With commit-confirm the page shows the time left; one click rolls back to the old text."""
    reader = opened()
    page = reader.go("policy")
    first = appliance.rest().get("/v1/policy").json["text"]
    reader.write(first + "\n# on trial\n")
    page.get_by_role("button", name="Load", exact=True).click()
    page.get_by_role("dialog").get_by_label("Commit-confirm").select_option("300")
    page.get_by_role("dialog").get_by_role("button", name="Load the policy").click()
    expect(page.get_by_text(re.compile("rolls back in .* unless confirmed"))).to_be_visible()
    page.get_by_role("button", name="Roll back now").click()
    expect(page.get_by_text(re.compile("rolls back in .* unless confirmed"))).to_have_count(0)
    expect(reader.editor()).not_to_contain_text("shadow")
    assert appliance.rest().get("/v1/policy").json["text"] == first


def test_a_policy_that_ends_connections_rolls_back_unless_confirmed(
    appliance: Appliance, opened: Callable[..., Reader], attempt: Callable[..., Any]
) -> None:
    """The dialog preselects five minutes, also for a person who does not wait for the dry run."""
    assert attempt("registerPublisher", "/loud", "/free", "std_msgs/String", "http://127.0.0.1:1/")[0] == 1
    reader = opened()
    page = reader.go("policy")
    first = appliance.rest().get("/v1/policy").json["text"]
    reader.write(first.replace("[Publishers]\n", "[Publishers]\n/free = 10.9.9.9\n"))
    page.get_by_role("button", name="Load", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Load the policy").click()
    expect(page.get_by_text(re.compile("rolls back in .* unless confirmed"))).to_be_visible()
    page.get_by_role("button", name="Roll back now").click()
    expect(page.get_by_text(re.compile("rolls back in .* unless confirmed"))).to_have_count(0)


def test_two_engineers_do_not_overwrite_each_other(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    """A text based on an older revision is rejected with the reason; the author can then load it over the new one."""
    reader = opened()
    page = reader.go("policy")
    rest = appliance.rest()
    text = rest.get("/v1/policy").json["text"]
    reader.write(text + "\n# mine\n")
    expect(page.get_by_text("changed here, not loaded")).to_be_visible()
    assert rest.post("/v1/policy", text + "\n# theirs\n", match="*").status == 200
    expect(page.get_by_text("came into force while you wrote")).to_be_visible()
    page.get_by_role("button", name="Load", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Load the policy").click()
    expect(page.get_by_role("dialog").get_by_text("Changed by someone else")).to_be_visible()
    assert "# theirs" in rest.get("/v1/policy").json["text"]
    page.get_by_role("dialog").get_by_role("button", name="Not yet").click()
    page.get_by_role("button", name="Keep my text, show the difference").click()
    expect(page.locator(".diff-line.removed")).to_contain_text("# theirs")
    expect(page.locator(".diff-line.added")).to_contain_text("# mine")


def test_it_explains_and_leads_to_the_line(opened: Callable[..., Reader]) -> None:
    """An explanation shows the rule that denies a request, its line, and the right to the node's name."""
    reader = opened()
    page = reader.go("policy?tab=explain")
    page.get_by_label("Host").fill("10.0.0.9")
    page.get_by_label("Node").fill("/joystick")
    page.get_by_label("What").fill("/guarded")
    page.get_by_role("button", name="Explain").click()
    found = page.locator("[data-explained]").first
    expect(found).to_contain_text("The request is denied")
    expect(found).to_contain_text("[Publishers] /guarded")
    found.get_by_role("button", name="line 7").first.click()
    expect(page.locator(".cm-lineNumbers .cm-activeLineGutter")).to_have_text("7")


def test_the_tests_of_the_policy_are_run_on_the_draft(opened: Callable[..., Reader]) -> None:
    """All cases pass on the policy in force; for a draft that fails one, the case and its expectation are shown."""
    reader = opened()
    page = reader.go("policy?tab=tests")
    page.get_by_role("button", name="Run the tests").click()
    expect(page.get_by_text("All 2 pass")).to_be_visible()
    reader.write(POLICY.replace("/guarded = 10.9.9.9 ", "/guarded = * "))
    page.get_by_role("button", name="Run the tests").click()
    expect(page.get_by_text("1 of 2 fail")).to_be_visible()
    expect(page.get_by_role("row", name="fail").first).to_contain_text("/guarded")


def test_an_older_revision_comes_back(appliance: Appliance, opened: Callable[..., Reader]) -> None:
    """The list of revisions shows the differences before a rollback, which becomes a new revision."""
    rest = appliance.rest()
    assert rest.post("/v1/policy", POLICY + "\n# to be undone\n", match="*").status == 200
    before = revision(appliance)
    reader = opened()
    page = reader.go("policy?tab=revisions")
    page.get_by_role("row", name="read at start").get_by_role("button", name="Roll back").click()
    dialog = page.get_by_role("dialog", name="Roll back to revision 1?")
    expect(dialog.locator(".diff")).to_contain_text("# to be undone")
    dialog.get_by_role("button", name="Roll back to revision 1").click()
    expect(reader.toast(f"Revision {before + 1} is in force")).to_be_visible()
    assert rest.get("/v1/policy").json["text"] == POLICY
