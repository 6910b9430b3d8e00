import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.audit.proof.copies import signed_checkpoints
from examples.landshark.lab import Lab
from fleet.tests.support.fleet_site import FleetSite
from tests.support.features.standby.standby_site import StandbySite
from tests.support.nodes import need_ros
from tests.support.requirements import need_program, need_root
from tests.support.waiting import eventually
from tests.system.fleet.test_bundles import BUNDLE, Operator, serve_bundles

COLLECTOR = "10.79.0.50"
NAMES = ("a", "b")


class Fleet(FleetSite):
    def _answers(self) -> bool:
        try:
            with socket.create_connection((self.address, self.port), 1):
                return True
        except OSError:
            return False

    def heard(self) -> dict[str, str | None]:
        rows = map(json.loads, self.run("robot", "list", "--json").stdout.splitlines())
        return {row["appliance"]: row["heard"] for row in rows}

    def proven(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.run("verify", "--json").stdout.splitlines()]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[tuple[Lab, StandbySite]]:
    need_root()
    need_program("nft", "nftables")
    need_ros()
    with Lab("rosrv-fleetpair") as lab, StandbySite(lab, tmp_path, monitors={}) as made:
        made.begin()
        yield lab, made


def test_both_join_and_a_takeover_goes_on(
    pair: tuple[Lab, StandbySite], database: str, tmp_path: Path
) -> None:
    lab, site = pair
    host = lab.host("collector", f"{COLLECTOR}/24")
    fleet = Fleet(tmp_path / "fleet", database, address=COLLECTOR, popen=host.popen)
    operator = Operator(fleet, tmp_path / "operator")
    with host.entered():
        serve_bundles(fleet, operator)
    try:
        _join(lab, site, fleet)
        _configure(site, operator)
        _restart(site, "b")
        eventually(lambda: fleet.heard()["b"], "the standby is heard without a log")
        _restart(site, "a")
        site.until_active("b")
        eventually(lambda: _all_pushed(site, fleet, "a"), "the new standby pushes its log")
        eventually(lambda: len(fleet.proven()) == 2, "the active appliance pushes")
        with host.entered():
            operator.rollout("start", BUNDLE)
        eventually(lambda: _bundles(site, "b") == (BUNDLE, False), "the active appliance takes a bundle")
        site.cut("b")
        site.until_active("a")
        eventually(lambda: _all_pushed(site, fleet, "a"), "the other appliance pushes after a takeover")
        eventually(lambda: _bundles(site, "a") == (BUNDLE, False), "it has the bundle, and polls")
        site.restore("b")
        eventually(
            lambda: _all_pushed(site, fleet, "b"), "the standby pushes what it recorded before the cut"
        )
        assert [(one["robot"], one["missing"]) for one in fleet.proven()] == [("arm7", 0)] * 2
    finally:
        fleet.kill()


def _join(lab: Lab, site: StandbySite, fleet: Fleet) -> None:
    whole = fleet.server.certificate.read_bytes() + fleet.server.ca.read_bytes()
    fleet.server.certificate.write_bytes(whole)
    for name, words in (("a", ()), ("b", ("--appliance", "b"))):
        file = fleet.folder / f"{name}.json"
        file.write_text(fleet.run("robot", "invite", "arm7", "--group", "site-a/arms", *words).stdout)
        appliance = site.appliances[name]
        with lab.hosts[name].entered():
            assert "arm7 is enrolled" in appliance.rosrv("fleet", "join", str(file)).stdout


def _configure(site: StandbySite, operator: Operator) -> None:
    for appliance in site.appliances.values():
        root, config = appliance.directory / "root.json", appliance.directory / "appliance.yaml"
        root.write_bytes((operator.repository / "root.json").read_bytes())
        root.chmod(0o644)
        bundles = {"root": str(root), "interval": 5, "confirm_seconds": 1}
        config.write_text(json.dumps({"fleet": {"bundles": bundles}}))
        appliance.options = ("--config", str(config), *appliance.options)


def _bundles(site: StandbySite, name: str) -> tuple[str, bool] | None:
    state = site.appliances[name].status()["bundles"]
    return None if state["checked"] is None else (state["in_force"], state["changed"])


def _restart(site: StandbySite, name: str) -> None:
    process = site.appliances[name].process
    assert process is not None
    process.stop()
    site.start(name)
    site.until_both_in_sync()


def _all_pushed(site: StandbySite, fleet: Fleet, name: str) -> bool:
    log = site.appliances[name].state / "control" / "audit.db"
    last = signed_checkpoints(log, 0, 1_000_000)[-1]
    found = {proof["log"]: proof["last"] for proof in fleet.proven()}
    return bool(found.get(last.log) == last.sequence)
