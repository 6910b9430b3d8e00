import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.support.appliance import Appliance
from tests.support.site_key import LINE, signed
from tests.system.console.conftest import CONFIG, POLICY
from tests.system.console.reader import Reader

NOTICE = 'For staff of "Example" only.\nWhat you do is <b>recorded</b>.'
SPECIFICATION = "count() { event said() /chatter std_msgs/String '{}' { } }\n"


@pytest.fixture(scope="module")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    config = tmp_path_factory.mktemp("console") / "appliance.yaml"
    config.write_text(f"{CONFIG}site_keys: [{LINE}]\napi_notice: {json.dumps(NOTICE)}\n")
    running = Appliance(policy=POLICY, options=("--config", str(config)))
    Path(f"{running.policy_file}.sig").write_text(signed(POLICY))
    with running:
        yield running


def test_the_notice_of_the_site_is_shown_before_a_token_is_given(
    browser: Browser, appliance: Appliance
) -> None:
    with Reader(browser, str(appliance.ready["api"])) as reader:
        reader.page.goto(reader.url)
        notice = reader.page.get_by_role("note", name="Site notice")
        expect(notice).to_be_visible()
        assert notice.inner_text() == NOTICE
        expect(reader.page.get_by_label("Access token")).to_be_visible()
        assert reader.axe() == []


def test_a_policy_is_loaded_with_its_signature_only(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    text = POLICY + "# another\n"
    reader = opened()
    page = reader.go("policy")
    reader.write(text)
    page.get_by_role("button", name="Load", exact=True).click()
    dialog = page.get_by_role("dialog")
    expect(dialog.get_by_role("alert")).to_contain_text("it has no signature of the site")
    dialog.get_by_label("Site signature").fill(signed(text))
    expect(dialog.get_by_role("alert")).to_have_count(0)
    dialog.get_by_role("button", name="Load the policy").click()
    expect(reader.toast("Revision 2 is in force")).to_be_visible()
    assert appliance.rest().get("/v1/policy").json["signature"] == signed(text)


def test_a_specification_is_loaded_with_its_signature_only(
    appliance: Appliance, opened: Callable[..., Reader], tmp_path: Path
) -> None:
    file, beside = tmp_path / "count.rv", tmp_path / "count.rv.sig"
    file.write_text(SPECIFICATION)
    beside.write_text(signed(SPECIFICATION))
    reader = opened()
    page = reader.go("monitors")
    page.get_by_role("button", name="Load").first.click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Take it from files").set_input_files(file)
    dialog.get_by_role("button", name="Load", exact=True).click()
    expect(dialog).to_contain_text("it has no signature of the site")
    dialog.get_by_label("Take it from files").set_input_files([file, beside])
    expect(dialog.get_by_label("Site signature")).to_have_value(signed(SPECIFICATION))
    dialog.get_by_role("button", name="Load", exact=True).click()
    expect(dialog).to_have_count(0)
    assert appliance.rest().get("/v1/monitors").json["monitors"][0]["name"] == "count"
