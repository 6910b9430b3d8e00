import json
import tarfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Playwright, expect

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.requirements import need_root
from tests.support.tunnels import need_strongswan
from tests.system.console.conftest import POLICY, launch
from tests.system.console.reader import Reader


@pytest.fixture
def appliance(tmp_path: Path) -> Iterator[Appliance]:
    need_root()
    need_strongswan()
    config = tmp_path / "appliance.yaml"
    config.write_text("api: 0.0.0.0:8443\napi_networks: [10.84.0.0/24]\n")
    with Lab("rosrv-console") as lab:
        host = lab.host("machine", "10.84.0.2/24")
        with Appliance(
            host, policy=POLICY, options=("--config", str(config), "--listen", "0.0.0.0:11311")
        ) as running:
            yield running


@pytest.fixture
def inside(appliance: Appliance, playwright: Playwright, chromium: str, tmp_path: Path) -> Iterator[Browser]:
    host = appliance.host
    assert isinstance(host, Host)
    program = tmp_path / "chromium"
    program.write_text(f'#!/bin/sh\nexec ip netns exec {host.namespace.name} {chromium} "$@"\n')
    program.chmod(0o755)
    started = launch(playwright, str(program))
    yield started
    started.close()


def test_a_host_is_enrolled_and_revoked(appliance: Appliance, inside: Browser) -> None:
    with Reader(inside, "https://127.0.0.1:8443", str(appliance.ready["token"])) as reader:
        page = reader.go("hosts")
        expect(page.get_by_text("No host is enrolled")).to_be_visible()
        page.get_by_role("button", name="Enrol a host").click()
        dialog = page.get_by_role("dialog", name="Enrol a host")
        dialog.get_by_label("Name").fill("ocu-1")
        dialog.get_by_label("How").select_option("kit")
        dialog.get_by_label("Address of the appliance").fill("10.84.0.2")
        with page.expect_download() as download:
            dialog.get_by_role("button", name="Create the kit").click()
        with tarfile.open(download.value.path()) as kit:
            assert [name for name in kit.getnames() if "/private/" in name], kit.getnames()
        row = page.locator("[data-host=ocu-1]")
        expect(row).to_contain_text("down")

        page.get_by_role("button", name="Enrol a host").click()
        dialog.get_by_label("Name").fill("ocu-2")
        dialog.get_by_label("Address of the appliance").fill("10.84.0.2")
        dialog.get_by_role("button", name="Create the token").click()
        made = page.get_by_role("dialog", name="ocu-2 may enrol itself")
        expect(made.locator("[data-token]").last).to_contain_text("rosrv-enrol_")
        with page.expect_download() as script:
            made.get_by_role("button", name="Download the script").click()
        assert script.value.path().read_text().startswith("#!")
        made.get_by_role("button", name="Done").click()
        expect(page.locator("[data-host=ocu-2]")).to_contain_text("awaited")

        row.get_by_role("button", name="Revoke").click()
        question = page.get_by_role("dialog", name="Revoke ocu-1?")
        button = question.get_by_role("button", name="Revoke ocu-1")
        expect(button).to_have_attribute("aria-disabled", "true")
        question.get_by_label("Type ocu-1 to confirm").fill("ocu-1")
        button.click()
        expect(row).to_contain_text("revoked")
    listed = map(json.loads, appliance.rosrv("host", "list", "--json").stdout.splitlines())
    assert {one["name"]: one["state"] for one in listed} == {"ocu-1": "revoked", "ocu-2": "awaited"}
    events = appliance.recorded("--event", "host revoked")
    assert [event["detail"]["name"] for event in events] == ["ocu-1"]
