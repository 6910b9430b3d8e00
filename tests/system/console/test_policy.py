import http.client
import re
import urllib.parse
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, Route, expect

from roswire.xmlrpc import build_call, parse_response
from tests.support.appliance import Appliance
from tests.support.robot import MACHINES, Robot
from tests.support.waiting import eventually
from tests.system.console.conftest import CONFIG, POLICY
from tests.system.console.reader import Reader

TESTS = """\
cases:
  - host: 10.0.0.9
    node: /joystick
    allow: [publish /cmd_vel]
    deny: [publish /guarded]
"""


_TYPE_AT_ONCE = """
const attach = Element.prototype.attachShadow;
Element.prototype.attachShadow = function (options) {
  const root = attach.call(this, options);
  const type = () => {
    root.querySelector(".cm-content").focus();
    document.execCommand("insertText", false, "# at once");
  };
  new MutationObserver((_records, observer) => {
    observer.disconnect();
    setTimeout(type);
  }).observe(root, { childList: true });
  return root;
};
"""


@pytest.fixture(scope="module")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    config = tmp_path_factory.mktemp("console") / "appliance.yaml"
    config.write_text(CONFIG)
    running = Appliance(policy=POLICY, options=("--config", str(config)))
    Path(f"{running.policy_file}.tests.yaml").write_text(TESTS)
    with running:
        yield running


def revision(appliance: Appliance) -> int:
    return int(appliance.rest().get("/v1/policy").json["revision"])


def test_an_error_is_shown_at_its_line_and_changes_nothing(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    before = revision(appliance)
    reader = opened()
    page = reader.go("policy")
    load = page.get_by_role("button", name="Load", exact=True)
    reader.write(POLICY.replace("[Subscribers]", "bogus\n[Subscribrs]"))
    finding = page.locator(".finding").first
    expect(finding).to_contain_text("9:1")
    expect(finding).to_contain_text("key = value")
    expect(page.locator(".finding").nth(1)).to_contain_text("did you mean Subscribers?")
    expect(page.locator(".cm-lint-marker-error")).to_have_count(2)
    finding.click()
    expect(page.locator(".cm-lineNumbers .cm-activeLineGutter")).to_have_text("9")
    expect(load).to_have_attribute("aria-disabled", "true")
    expect(load).to_have_accessible_description("2 errors")
    load.press("Enter")
    expect(page.get_by_role("dialog")).to_have_count(0)
    reader.write(POLICY + "\n# without errors\n")
    expect(load).not_to_have_attribute("aria-disabled", "true")
    expect(page.get_by_text("2 errors", exact=True)).to_have_count(0)
    assert revision(appliance) == before


def test_the_editor_has_exactly_the_typed_text(opened: Callable[..., Reader]) -> None:
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


def test_text_that_is_typed_at_once_stays(opened: Callable[..., Reader]) -> None:
    reader = opened()
    reader.context.add_init_script(_TYPE_AT_ONCE)
    page = reader.go("policy")
    expect(page.get_by_text("changed here, not loaded")).to_be_visible()
    page.get_by_role("tab", name="Diff").click()
    expect(page.locator(".diff-line.added")).to_contain_text("# at once")
    expect(reader.editor()).to_contain_text("# at once")


def test_the_editor_completes_by_keys(appliance: Appliance, opened: Callable[..., Reader]) -> None:
    address = min(MACHINES)
    with Robot(appliance.master_uri):
        reader = opened()
        page = reader.go("policy")
        reader.write("[Groups]\ntablets = 10.0.0.8\n\n")
        proposals = page.get_by_role("listbox", name="Completions")

        def choose(typed: str, proposed: str) -> None:
            page.keyboard.type(typed)
            first = proposals.get_by_role("option").first
            expect(first).to_have_accessible_name(proposed)
            page.keyboard.press("ArrowDown")
            expect(first).to_have_attribute("aria-selected", "true")
            page.keyboard.press("Enter")
            expect(proposals).to_have_count(0)

        page.keyboard.type("[Pu")
        expect(proposals.get_by_role("option")).to_have_count(1)
        choose("b", "[Publishers] section")  # a further letter does not interrupt the choice
        page.keyboard.press("Enter")
        choose("/lidar/r", "/lidar/range topic")
        choose(" = tab", "tablets group")
        choose(f" {address[:-1]}", f"{address} host")
        expect(reader.editor()).to_contain_text(f"[Publishers]/lidar/range = tablets {address}")
        page.keyboard.press("Enter")
        page.keyboard.type("/lid")
        expect(proposals).to_be_visible()
        page.keyboard.press("Escape")
        expect(proposals).to_have_count(0)
        page.keyboard.type("ar = ")
        page.keyboard.press("Control+Space")
        expect(proposals.get_by_role("option", name="robot group")).to_be_visible()
        # axe does not know that the arrow keys, pressed in the editor, scroll its list
        assert [one for one in reader.axe() if not one.startswith("scrollable-region-focusable")] == []
    reader.write("[Groups]\ntablets = 10.0.0.8\n\n[Nodes]\n/a = ")
    page.keyboard.type("tab")
    expect(proposals).to_be_visible()
    page.keyboard.press("Enter")  # without a choice: it ends the line
    page.keyboard.type("/b")
    assert str(reader.editor().inner_text()).endswith("/a = tab\n/b")


def test_the_first_view_does_not_load_the_editor(opened: Callable[..., Reader]) -> None:
    reader = opened()
    page = reader.go("now")
    reader.settle()
    assert not [url for url in reader.asked if "codemirror" in url]
    page.keyboard.press("4")
    expect(reader.editor()).to_be_visible()
    assert [url for url in reader.asked if "codemirror" in url]
    assert not [url for url in reader.asked if url.endswith("/v1/graph")]


def test_a_page_that_is_older_than_the_appliance_says_so(opened: Callable[..., Reader]) -> None:
    reader = opened()
    page = reader.go("now")
    for view, file in (("policy", "codemirror"), ("graph", "dagre")):
        page.route(f"**/vendor/{file}*", lambda route: route.fulfill(status=404))
        reader.go(view)
        failure = page.get_by_role("alert").filter(has_text="reload the page")
        expect(failure).to_be_visible()
        page.unroute(f"**/vendor/{file}*")
        failure.get_by_role("button", name="Try again").click()
        expect(failure).to_have_count(0)
    reader.go("policy")
    expect(reader.editor()).to_be_visible()


def test_a_right_text_is_loaded_with_its_comment(appliance: Appliance, opened: Callable[..., Reader]) -> None:
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


def publish(master: str, address: str, topic: str) -> None:
    node, port = f"/mover_{address[-1]}", urllib.parse.urlsplit(master).port
    call = build_call("registerPublisher", (node, topic, "std_msgs/String", f"http://{address}:1/"))
    with closing(http.client.HTTPConnection("127.0.0.1", port, source_address=(address, 0))) as connection:
        connection.request("POST", "/", call, {"Content-Type": "text/xml"})
        answer = parse_response(connection.getresponse().read())
    assert isinstance(answer, list), answer
    assert answer[0] == 1, answer


def test_a_dry_run_groups_what_would_end_by_host(appliance: Appliance, opened: Callable[..., Reader]) -> None:
    for address, topics in (("127.0.0.2", ["/wheel"]), ("127.0.0.3", ["/arm", "/hand", "/head"])):
        for topic in topics:
            publish(appliance.master_uri, address, topic)
    reader = opened()
    page = reader.go("policy")
    denied = "".join(f"{topic} = 10.9.9.9\n" for topic in ("/wheel", "/arm", "/hand", "/head"))
    reader.write(POLICY.replace("[Publishers]\n", f"[Publishers]\n{denied}"))
    page.get_by_role("button", name="Dry run").click()
    notice = page.get_by_role("status").filter(has_text="would end 4 live connections")
    lines = notice.locator("summary")
    expect(lines).to_have_text(["127.0.0.3: 3 connections", "127.0.0.2: 1 connection"])
    expect(notice.get_by_text("/hand")).to_be_hidden()
    lines.first.press("Enter")
    expect(notice.get_by_text("/hand")).to_be_visible()
    expect(notice.get_by_text("/wheel")).to_be_hidden()


def test_commit_confirm_keeps_or_rolls_back_a_policy(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
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


def page_with_an_outdated_draft(appliance: Appliance, reader: Reader) -> Page:
    page = reader.go("policy")
    rest = appliance.rest()
    text = rest.get("/v1/policy").json["text"]
    reader.write(text + "\n# mine\n")
    expect(page.get_by_text("changed here, not loaded")).to_be_visible()
    assert rest.post("/v1/policy", text + "\n# theirs\n", match="*").status == 200
    expect(page.get_by_text("came into force while you wrote")).to_be_visible()
    return page


def test_two_engineers_do_not_overwrite_each_other(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    page = page_with_an_outdated_draft(appliance, opened())
    page.get_by_role("button", name="Load", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Load the policy").click()
    expect(page.get_by_role("dialog").get_by_text("Changed by someone else")).to_be_visible()
    assert "# theirs" in appliance.rest().get("/v1/policy").json["text"]
    page.get_by_role("dialog").get_by_role("button", name="Not yet").click()
    page.get_by_role("button", name="Keep my text, show the difference").click()
    expect(page.locator(".diff-line.removed")).to_contain_text("# theirs")
    expect(page.locator(".diff-line.added")).to_contain_text("# mine")


def test_a_late_dry_run_does_not_clear_the_error_of_a_load(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    page = page_with_an_outdated_draft(appliance, opened())
    held: list[Route] = []

    def hold(route: Route) -> None:
        held.append(route)

    page.route("**/v1/policy?dry_run=1", hold, times=1)
    page.get_by_role("button", name="Load", exact=True).click()
    eventually(lambda: page.evaluate("true") and held, "the dialog's dry run")
    page.get_by_role("dialog").get_by_role("button", name="Load the policy").click()
    rejected = page.get_by_role("dialog").get_by_text("Changed by someone else")
    expect(rejected).to_be_visible()
    with page.expect_response("**/v1/policy?dry_run=1"):
        held[0].continue_()
    page.evaluate("new Promise(requestAnimationFrame)")
    page.evaluate("new Promise(requestAnimationFrame)")
    expect(rejected).to_be_visible()


def test_it_explains_and_leads_to_the_line(opened: Callable[..., Reader]) -> None:
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
    reader = opened()
    page = reader.go("policy?tab=tests")
    page.get_by_role("button", name="Run the tests").click()
    expect(page.get_by_text("All 2 pass")).to_be_visible()
    reader.write(POLICY.replace("/guarded = 10.9.9.9 ", "/guarded = * "))
    page.get_by_role("button", name="Run the tests").click()
    expect(page.get_by_text("1 of 2 fail")).to_be_visible()
    expect(page.get_by_role("row", name="fail").first).to_contain_text("/guarded")


def test_an_older_revision_comes_back(appliance: Appliance, opened: Callable[..., Reader]) -> None:
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


# For each pair of texts: whether the page calls them the same, and the removed and the added lines that it shows.
_SHOWN = """async (pairs) => {
  const { html, render } = await import("/console/static/vendor/preact.js");
  const { Difference } = await import("/console/static/js/parts/difference.js");
  return pairs.map(([old, now]) => {
    const place = document.createElement("div");
    render(html`<${Difference} old=${old} now=${now} same="the same" />`, place);
    const of = (kind) => [...place.querySelectorAll(`.diff-line.${kind} > span:last-child`)]
      .map((one) => one.textContent.replace(/^(removed|added): /, ""));
    const shown = [place.textContent === "the same", of("removed"), of("added")];
    render(null, place);
    return shown;
  });
}"""


def test_each_difference_of_two_texts_is_shown(opened: Callable[..., Reader]) -> None:
    """At any line and any character: a colleague's rule may stand far down, or at the end of a long line."""
    page = opened().go("policy")
    for lines, line in ((1, 1), (4001, 4001), (20_000, 4001), (20_000, 20_000)):
        for width, place in ((10, 1), (500, 401), (50_000, 1), (50_000, 50_000)):
            before = ["same"] * lines
            before[line - 1] = "x" * width
            after = list(before)
            after[line - 1] = "x" * (place - 1) + "ANOTHER" + "x" * (width - place)
            texts = ["\n".join(one) for one in (before, after)]
            same, removed, added = page.evaluate(_SHOWN, [texts])[0]
            assert not same
            assert removed != added
            assert ["ANOTHER" in one for one in added] == [True]
    assert page.evaluate(_SHOWN, [["a\nb", "a\nb"]]) == [[True, [], []]]
    far = ["\n".join([first, *["same"] * 5000, last]) for first, last in (("a", "b"), ("c", "d"))]
    same, removed, added = page.evaluate(_SHOWN, [far])[0]
    assert not same
    assert (removed[0], removed[-1], added[0], added[-1]) == ("a", "b", "c", "d")


def test_no_earlier_revision_is_called_the_one_in_force(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    reader = opened()
    page = reader.go("policy")
    reader.write(POLICY + "# a change\n")
    page.get_by_role("button", name="Load", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Load the policy").click()
    expect(page.get_by_role("dialog")).to_have_count(0)
    loaded = page.get_by_role("tabpanel").get_by_text(f"Revision {revision(appliance)} is in force")
    expect(loaded).to_be_visible()
    assert appliance.rest().post("/v1/policy", POLICY, match="*").status == 200
    expect(page.locator(".head-sub")).to_contain_text(f"revision {revision(appliance)} in force")
    expect(page.get_by_role("tabpanel").get_by_text(re.compile(r"Revision \d+ is in force"))).to_have_count(0)
