import re
from dataclasses import fields
from pathlib import Path

from appliance.configuration.config_sources import resolve
from appliance.configuration.inventory import RUNS
from appliance.network import boot_hold
from appliance.supervisor.privileges import SUPERVISOR_CAPABILITIES
from distribution.environment import INTERPRETERS

ROOT = Path(__file__).parents[2]


def test_it_depends_on_what_the_image_has() -> None:
    stage = (ROOT / "Dockerfile").read_text().partition("FROM ${BASE} AS appliance")[2]
    installed = re.search(r"--no-install-recommends \\\n((?: +\S+ \\\n)+)", stage)
    assert installed is not None
    assert set(installed[1].split()) - {"\\", "tini", "${PINS}"} == set(RUNS)


def test_each_dependency_has_its_reason() -> None:
    listed = {line.partition("#")[0].strip() for line in (ROOT / "packages.txt").read_text().splitlines()}
    assert set(RUNS) <= listed


def test_the_service_has_the_rights_of_the_supervisor() -> None:
    unit = (ROOT / "distribution/debian/rosrv.service").read_text()
    given = {
        name.removeprefix("CAP_")
        for line in re.findall(r"^CapabilityBoundingSet=(.*)$", unit, re.MULTILINE)
        for name in line.split()
    }
    assert given == set(SUPERVISOR_CAPABILITIES)


def test_no_number_of_starts_ends_the_service() -> None:
    unit = (ROOT / "distribution/debian/rosrv.service").read_text()
    assert "\nStartLimitIntervalSec=0\n" in unit
    assert "\nRestart=on-failure\n" in unit
    assert "StartLimitBurst" not in unit


def test_the_boot_hold_comes_and_goes_with_the_enabled_service() -> None:
    hold = (ROOT / "distribution/debian/rosrv-hold.service").read_text()
    unit = (ROOT / "distribution/debian/rosrv.service").read_text()
    assert "[Install]" not in hold, "it would hold while rosrv.service is disabled or masked"
    assert "\nPartOf=rosrv.service\n" in hold, "StopPropagatedFrom= would also lift it at a crash"
    assert "\nBefore=network-pre.target\n" in hold
    for key in ("Wants", "After"):
        assert re.search(rf"^{key}=.*\brosrv-hold\.service\b", unit, re.MULTILINE)
    assert boot_hold.UNIT_RUNS.name == re.findall(r"^RuntimeDirectory=(.*)$", hold, re.MULTILINE)[0]
    assert boot_hold.STATE.name == re.findall(r"^StateDirectory=(.*)$", hold, re.MULTILINE)[0]


def test_the_installed_configuration_is_right() -> None:
    file = ROOT / "distribution/appliance.yaml"
    settings = resolve(file, {}, {})
    assert settings.enable == "none"
    keys = re.findall(r"^(?:# )?([a-z_]+):", file.read_text(), re.MULTILINE)
    assert set(keys) <= {field.name for field in fields(settings)}


def test_it_serves_the_interpreters_that_it_says() -> None:
    control = (ROOT / "distribution/debian/control").read_text()
    bounds = re.findall(r"python3 \((>=|<<) 3\.(\d+)\)", control)
    assert [f"3.{minor}" for minor in range(int(bounds[0][1]), int(bounds[1][1]))] == list(INTERPRETERS)
