"""Tests of enrolment in control: names, addresses, what happens first when a host is revoked."""

import asyncio
import ipaddress
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from appliance.audit.log import AuditLog
from appliance.channel.messages import CertificateMade, Message, TunnelsEnclosed, TunnelsWanted
from appliance.ipsec import authority as ipsec
from appliance.ipsec.proof import RequestRefusedError
from appliance.ipsec.requests import make_key, signing_request
from appliance.master.authority import Authority, AuthorityError
from appliance.master.declared import Declared
from appliance.master.host_table import HostRefusedError, HostTable
from appliance.master.hosts import Hosts
from appliance.master.recorder import Recorder
from appliance.master.rest_place import RestPlace
from appliance.master.tunnels import Tunnels
from appliance.policy.model import Address
from appliance.store.state import StateStore


class NearAuthority(Authority):
    """The real authority, asked without a link."""

    def __init__(self, directory: Path) -> None:
        super().__init__()
        self._near = ipsec.Authority(directory)
        self.meanwhile: Callable[[], object] = lambda: None

    async def certificate(self) -> bytes:
        """Its certificate."""
        return self._near.certificate

    async def issue(
        self, request: bytes, name: str, days: float, *, proof: bytes = b"", former: bytes = b""
    ) -> CertificateMade:
        """A certificate, or the refusal as it comes over the link; `meanwhile` happens before."""
        self.meanwhile()
        await asyncio.sleep(0)
        try:
            issued = self._near.issue(request, name, days, proof=proof, former=former)
        except RequestRefusedError as error:
            raise AuthorityError(str(error), refused=True) from error
        return CertificateMade(0, issued.certificate, issued.serial, issued.expires)


class Bench:
    """Hosts with a store and a log of their own, and a supervisor that answers `answer`."""

    def __init__(self, directory: Path, *, listen: str = "0.0.0.0", pool: str = "10.113.11.0/29") -> None:
        self.answer = TunnelsEnclosed("kernel")
        self.asked: list[Message] = []
        self.order: list[str] = []
        self.store = StateStore(directory, failed=pytest.fail)
        self.log = AuditLog(directory / "audit.db")
        self.declared = directory / "hosts.yaml"
        self.authority = NearAuthority(directory)
        recorder = Recorder(self.log, strict=False, deny_when_failed=False)
        self.table = HostTable(self.store, ipaddress.IPv4Network(pool), Declared(self.declared))
        self.tunnels = Tunnels(self.table, recorder, self.authority, listen=(listen, 11311), say=self._said)
        self.hosts = Hosts(
            self.store,
            recorder,
            self.authority,
            self.table,
            self.tunnels,
            master_port=11311,
            rest=RestPlace(8443, "", 8443),
        )
        self.hosts.served_by("sha256//pin")
        self.hosts.changed = self._changed
        self.hosts.expel = self._expel

    def close(self) -> None:
        """End the threads."""
        self.store.close()
        self.log.close()

    def _said(self, message: Message) -> None:
        self.asked.append(message)
        self.tunnels.answered(self.answer)

    def _changed(self) -> int:
        self.order.append(f"policy {sorted(self.hosts.addresses)}")
        return 1

    def _expel(self, address: Address, reason: str) -> int:
        self.order.append(f"expel {address}")
        return 2


def add(bench: Bench, name: str, address: str | None = None) -> Coroutine[Any, Any, dict[str, Any]]:
    """Enrol a host with a key of its own."""
    return bench.hosts.add(
        name, signing_request(make_key(), name).decode(), days=90, address=address, who="tester"
    )


@pytest.fixture(autouse=True)
def nobody_waits_for_charon(monkeypatch: pytest.MonkeyPatch) -> None:
    """There is none here: its answer is not awaited."""
    monkeypatch.setattr("appliance.master.tunnels._TAKEN_SECONDS", 0.0)


def run(directory: Path, work: Callable[[Bench], Coroutine[Any, Any, None]], **options: str) -> None:
    """Run a test's work on a bench."""

    async def inside() -> None:
        bench = Bench(directory, **options)
        try:
            await work(bench)
        finally:
            bench.close()

    asyncio.run(inside())


def test_addresses_are_given_in_order_and_kept(tmp_path: Path) -> None:
    """The first is the appliance's; declared ones are kept free; a revoked host's is given to no other."""

    async def work(bench: Bench) -> None:
        bench.declared.write_text("hosts:\n  - name: laptop\n    address: 10.113.11.3\n")
        await bench.hosts.reload("tester")
        assert (await add(bench, "a"))["address"] == "10.113.11.2"
        assert (await add(bench, "b"))["address"] == "10.113.11.4"
        assert (await add(bench, "laptop"))["address"] == "10.113.11.3"
        await bench.hosts.revoke("a", "tester")
        assert (await add(bench, "c"))["address"] == "10.113.11.5"
        assert (await add(bench, "a"))["address"] == "10.113.11.2"
        assert (await add(bench, "d"))["address"] == "10.113.11.6"
        with pytest.raises(HostRefusedError, match=r"take a larger ipsec\.pool"):
            await add(bench, "e")

    run(tmp_path, work)


@pytest.mark.parametrize("address", ["10.113.11.1", "10.113.12.2", "10.113.11", "::1", "10.113.11.2"])
def test_an_address_that_cannot_be_had_is_refused(tmp_path: Path, address: str) -> None:
    """The appliance's own, one outside the pool, nonsense, and one that is taken."""

    async def work(bench: Bench) -> None:
        await add(bench, "a")
        with pytest.raises(HostRefusedError, match="address"):
            await add(bench, "b", address)

    run(tmp_path, work)


@pytest.mark.parametrize("name", ["", "rosrv-appliance", "a b", "../a", "x" * 64, "a\n"])
def test_a_name_that_cannot_be_had_is_refused(tmp_path: Path, name: str) -> None:
    """Above all not the appliance's own: a host with it could stand for the appliance."""

    async def work(bench: Bench) -> None:
        with pytest.raises(HostRefusedError, match="no name for a host"):
            await bench.hosts.add(name, "", days=90, who="tester")

    run(tmp_path, work)


def test_without_a_firewall_no_name_stands_for_an_address(tmp_path: Path) -> None:
    """The supervisor cannot keep clear text out: nobody is enrolled, and hosts of an earlier life are nobody."""

    async def enrol(bench: Bench) -> None:
        await add(bench, "a")
        assert list(bench.hosts.addresses) == ["a"]

    async def again(bench: Bench) -> None:
        bench.answer = TunnelsEnclosed(None, "no firewall here")
        await bench.hosts.start()
        assert isinstance(bench.asked[0], TunnelsWanted)
        assert bench.hosts.addresses == {}
        assert "no firewall here" in bench.hosts.status()["troubles"][0]
        with pytest.raises(HostRefusedError, match="no firewall here"):
            await add(bench, "b")

    run(tmp_path, enrol)
    run(tmp_path, again)


def test_a_master_that_cannot_be_reached_in_the_tunnel_is_said(tmp_path: Path) -> None:
    """An appliance that listens on one address of the network is not there for hosts in tunnels."""

    async def work(bench: Bench) -> None:
        with pytest.raises(HostRefusedError, match=r"listen: 0\.0\.0\.0:11311"):
            await add(bench, "a")

    run(tmp_path, work, listen="192.168.1.20")


def test_revoked_is_out_of_the_policy_before_anything_is_awaited(tmp_path: Path) -> None:
    """The policy first, then what the host has; and its certificate is on the list for good."""

    async def work(bench: Bench) -> None:
        await add(bench, "a")
        bench.order.clear()
        body = await bench.hosts.revoke("a", "tester")
        assert bench.order == ["policy []", "expel 10.113.11.2"]
        assert body["taken_back"] == 3
        assert [serial for serial, _moment in bench.store.hosts.revoked()] == [body["serial"]]
        with pytest.raises(HostRefusedError, match="enrolled are: none"):
            await bench.hosts.revoke("a", "tester")

    run(tmp_path, work)


def test_a_new_certificate_revokes_the_one_before(tmp_path: Path) -> None:
    """The address stays; there is no second enrolment of a name that is enrolled."""

    async def work(bench: Bench) -> None:
        first = await add(bench, "a")
        with pytest.raises(HostRefusedError, match="rosrv host kit a"):
            await add(bench, "a")
        second = await bench.hosts.renew(
            "a", signing_request(make_key(), "a").decode(), days=90, who="tester"
        )
        assert second["address"] == first["address"]
        assert [serial for serial, _moment in bench.store.hosts.revoked()] == [first["serial"]]

    run(tmp_path, work)


def test_a_bad_request_enrols_nobody(tmp_path: Path) -> None:
    """What the authority refuses is refused whole."""

    async def work(bench: Bench) -> None:
        with pytest.raises(HostRefusedError, match="not a signing request"):
            await bench.hosts.add("a", "rubbish", days=90, who="tester")
        assert bench.hosts.rows() == []

    run(tmp_path, work)


def test_declared_and_not_enrolled_is_shown(tmp_path: Path) -> None:
    """The list has both kinds of divergence from the baseline."""

    async def work(bench: Bench) -> None:
        bench.declared.write_text("hosts:\n  - name: laptop\n")
        await bench.hosts.reload("tester")
        await add(bench, "a")
        rows = {row["name"]: (row["state"], row["declared"]) for row in bench.hosts.rows()}
        assert rows == {"a": ("down", False), "laptop": ("not enrolled", True)}
        bench.declared.write_text("hosts: [")
        with pytest.raises(HostRefusedError, match="what was declared before holds"):
            await bench.hosts.reload("tester")
        assert [row["name"] for row in bench.hosts.rows()] == ["a", "laptop"]
        assert any("hosts.yaml" in trouble for trouble in bench.hosts.status()["troubles"])

    run(tmp_path, work)
