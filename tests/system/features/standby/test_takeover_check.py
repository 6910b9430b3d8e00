"""When the standby could not serve, both appliances report it, and the standby does not claim until it recovers.

The standby `b` has keys of the site, which `a` does not know. Each test brings the policy into force that it needs.
"""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.channel import admin
from appliance.features.standby import requests as standby_requests
from examples.landshark.lab import Lab
from tests.support.appliance import OPEN_POLICY
from tests.support.features.standby.standby_site import StandbySite
from tests.support.nodes import need_ros
from tests.support.printed import row_of
from tests.support.requirements import need_program, need_root
from tests.support.site_key import LINE, signed
from tests.support.waiting import NoAnswerError, eventually
from tests.system.features.standby.conftest import RULE

NO_SIGNATURE = "it has no signature of the site"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StandbySite]:
    need_root()
    need_program("nft", "nftables")
    need_ros()
    home: Path = tmp_path_factory.mktemp("unready")
    with Lab("rosrv-unready") as lab, StandbySite(lab, home, monitors={}) as made:
        standby = made.appliances["b"]
        config = standby.directory / "appliance.yaml"
        file = standby.policy_file  # checked at the start, although a takeover uses the replicated policy
        file.with_name(f"{file.name}.sig").write_text(signed(file.read_text()))
        config.write_text(f"site_keys:\n  - {LINE}\n")
        standby.options = ("--config", str(config), *standby.options)
        made.begin()
        yield made


def until_obstacle(site: StandbySite, words: str, *names: str) -> None:
    def reported(name: str) -> bool:
        done = site.appliances[name].rosrv("standby", "status", "--json", check=False)
        state = row_of(done)
        obstacle, troubles = state["obstacle"], state["troubles"]
        if not words:
            return obstacle == "" and troubles == [] and done.returncode == 0
        text = f"the standby b (10.79.0.3) cannot take over: {obstacle}"
        return words in obstacle and text in " ".join(troubles) and done.returncode == 1

    for name in names:
        eventually(lambda name=name: reported(name), site.story)  # type: ignore[misc]  # mypy infers no type for a lambda's default


def load(site: StandbySite, text: str, signature: str) -> None:
    site.appliances[site.holder()].ask(admin.PolicyLoad(text, signature=signature))


def make_ready(site: StandbySite) -> None:
    load(site, OPEN_POLICY, signed(OPEN_POLICY))
    until_obstacle(site, "", "a", "b")


def test_other_site_keys(site: StandbySite) -> None:
    """A switchover is refused with the reason, and after a power cut the standby waits for the active appliance. The
    first policy that it accepts makes it ready.
    """
    load(site, f"{OPEN_POLICY}# unsigned\n", "")
    until_obstacle(site, NO_SIGNATURE, "a", "b")
    for name in ("a", "b"):
        done = site.appliances[name].rosrv("standby", "switch", check=False)
        assert (done.returncode, NO_SIGNATURE in done.stderr) == (1, True), done
    assert site.holder() == "a"
    claims = site.lease.read().epoch
    site.cut("a")
    until_obstacle_without_active(site)
    assert (site.holder(), site.lease.read().epoch) == ("a", claims)
    site.restore("a")
    site.until_active("a")
    until_obstacle(site, NO_SIGNATURE, "a", "b")
    make_ready(site)


def until_obstacle_without_active(site: StandbySite) -> None:
    def waits() -> bool:
        state = site.appliances["b"].ask(standby_requests.StandbyWanted())
        return state.role == "standby" and (state.other.trouble_seconds or 0) > 5 and bool(state.obstacle)

    eventually(waits, site.story)


def test_a_policy_that_it_cannot_load(site: StandbySite) -> None:
    text = f"{OPEN_POLICY}[Options]\ntakeover = granted\n"
    load(site, text, "")
    until_obstacle(site, NO_SIGNATURE, "a", "b")
    load(site, text, signed(text))
    until_obstacle(site, "", "a", "b")


def test_a_missing_folder(site: StandbySite) -> None:
    """The active appliance has no stored specifications, so a takeover would read the folder of the standby.

    When the active appliance loses its power, the standby waits, and takes over as soon as its folder exists again.
    """
    make_ready(site)
    folder = site.appliances["b"].directory / "monitors"
    elsewhere = folder.rename(folder.with_name("elsewhere"))
    until_obstacle(site, f"{folder}: the folder of specifications does not exist", "a", "b")
    site.cut("a")
    until_obstacle_without_active(site)
    elsewhere.rename(folder)
    site.until_taken_over("b")
    site.until_active("b")
    site.restore("a")
    site.until_both_in_sync()
    site.promote("b")
    site.until_taken_over("a")
    site.until_active("a")
    site.until_both_in_sync()
    until_obstacle(site, "", "a", "b")


def test_a_specification_that_it_cannot_load(site: StandbySite) -> None:
    make_ready(site)
    one = site.appliances[site.holder()]
    one.ask(admin.MonitorLoad({"seen.rv": RULE}))
    until_obstacle(site, NO_SIGNATURE, "a", "b")
    one.ask(admin.MonitorLoad({"seen.rv": RULE}, signatures={"seen.rv": signed(RULE)}))
    until_obstacle(site, "", "a", "b")
    site.cut("a")
    site.until_taken_over("b")
    eventually(
        lambda: [row["name"] for row in site.appliances["b"].rows("monitor", "list")] == ["seen"], site.story
    )
    site.restore("a")


def test_a_change_that_it_still_checks(site: StandbySite) -> None:
    """The order to switch over is refused until the check has ended; after a power cut, nothing waits for it."""
    site.until_both_in_sync()
    active, standby = site.pair()

    def change(name: str) -> None:
        text = RULE.replace("seen", name)
        order = admin.MonitorLoad({"seen.rv": text}, signatures={"seen.rv": signed(text)})
        site.appliances[active].ask(order)

    change("one")
    until_obstacle(site, "", "a", "b")
    (compiler,) = site.pids(standby, "compiler")
    for name in (active, standby):
        os.kill(compiler, signal.SIGSTOP)  # for less than 5 s, or the supervisor kills it
        change(f"for_{name}")
        with pytest.raises(NoAnswerError, match="it still checks"):
            site.appliances[name].ask(standby_requests.StandbyPromote())
        os.kill(compiler, signal.SIGCONT)
        assert site.holder() == active
        until_obstacle(site, "", "a", "b")
    os.kill(compiler, signal.SIGSTOP)
    change("cut")
    site.cut(active)
    site.until_taken_over(standby)
    os.kill(compiler, signal.SIGCONT)
    site.until_active(standby)
