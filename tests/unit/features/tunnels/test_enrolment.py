import asyncio
import contextlib
import ipaddress
import itertools
import socket
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from appliance.base import clock, shipped
from appliance.base.clock import using
from appliance.channel.answers.host_answers import PortsSeen
from appliance.channel.channel import Channel
from appliance.channel.messages import (
    CertificateNeeded,
    Message,
    TunnelChanged,
    TunnelLink,
    TunnelsEnclosed,
    TunnelsReported,
    TunnelsStated,
    TunnelsWanted,
)
from appliance.control.operators.clock_check import ClockCheck
from appliance.features.tunnels.certification import Certification, RestAddress
from appliance.features.tunnels.enrolment import HostEnrolment
from appliance.features.tunnels.requests import (
    AuthorityWanted,
    HostAdd,
    HostEnrol,
    HostKit,
    HostList,
    HostPorts,
    HostRenew,
    HostRenewed,
    HostRenewItself,
    HostRevoke,
    HostsReload,
    HostToken,
    RevocationsWanted,
)
from appliance.features.tunnels.tunnel_answers import (
    Endpoint,
    EnrolmentToken,
    KitParts,
    NewCertificate,
    Reloaded,
    Revoked,
)
from appliance.hosts.appliances import Appliances
from appliance.hosts.certificate_requests import StoredAuthority
from appliance.hosts.host_table import HostForbiddenError, HostRefusedError, HostsChangedError, HostTable
from appliance.hosts.hosts_file import DeclaredHosts
from appliance.hosts.tunnel_state import Tunnels
from appliance.ipsec.requests import fingerprint, make_key, signing_request
from appliance.policy.model import Address
from appliance.store.host_tables import ApplianceRow
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from tests.support.audit import RecordingTrail
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase, open_log
from tests.support.memory_channel import memory_link
from tests.support.near_authority import NearAuthority
from tests.support.virtual_clock import VirtualClock

pytestmark = pytest.mark.anyio


class Bench:
    def __init__(self, directory: Path, *, listen: str = "0.0.0.0", pool: str = "10.113.11.0/29") -> None:
        self.answer = TunnelsEnclosed("kernel")
        self.asked: list[Message] = []
        self.order: list[str] = []
        self.blocked: set[Address] = set()
        self.store = StateStore(directory, failed=pytest.fail, kind=InlineDatabase)
        self.log = open_log(directory / "audit.db")
        self.declared = directory / "hosts.yaml"
        self.authority = NearAuthority(directory)
        self.trail = RecordingTrail(self.log)
        self.table = HostTable(self.store, ipaddress.IPv4Network(pool), DeclaredHosts(self.declared))
        self.shared = authority = StoredAuthority(self.authority, self.store.hosts)
        self.appliances = appliances = Appliances(self.store.hosts, self.table.revoked)
        self.tunnels = Tunnels(
            self.table, self.trail, authority, appliances, listen=(listen, 11311), say=self._said,
            blocked=lambda: self.blocked,
        )  # fmt: skip
        self.certification = certification = Certification(
            self.store, self.trail, authority, self.table, self.tunnels, appliances=appliances,
            master_port=11311, rest=RestAddress(8443, "", 8443), ends=ends_of(self.store, directory),
            changed=self._changed,
        )  # fmt: skip
        certification.served_by("sha256//pin")
        self.machines: dict[str, int] = {}
        self.each_hour = certification.each_hour
        self.relays = asyncio.Event()
        self.relays.set()
        self.hosts = HostEnrolment(
            certification,
            self._endpoint,
            expel=self._expel,
            carried_out=self._carried_out,
            machines=lambda: self.machines,
            in_words=lambda host: f"tablet ({host})" if host == "10.0.0.7" else host,
        )

    def close(self) -> None:
        self.store.close()
        self.log.close()

    def add(
        self, name: str, address: str | None = None, *, key: bytes | None = None
    ) -> Coroutine[Any, Any, KitParts]:
        request = signing_request(key or make_key(), name).decode()
        return self.hosts.add(HostAdd(name, request, 90, address), "tester")

    def renew(self, name: str) -> Coroutine[Any, Any, KitParts]:
        return self.hosts.renew(HostRenew(name, request_of(name), 90), "tester")

    def revoke(self, name: str) -> Coroutine[Any, Any, Revoked]:
        return self.hosts.revoke(HostRevoke(name), "tester")

    def reload(self) -> Coroutine[Any, Any, Reloaded]:
        return self.hosts.reload(HostsReload(), "tester")

    def token(
        self, name: str, *, seconds: float = 60, new: bool = True
    ) -> Coroutine[Any, Any, EnrolmentToken]:
        return self.hosts.token(HostToken(name, "10.0.0.1", token_seconds=seconds, new=new), "tester")

    def enrol(self, token: str, name: str) -> Coroutine[Any, Any, KitParts]:
        return self.hosts.itself.enrol(HostEnrol(token, request_of(name), "10.9.9.9"))

    def renew_itself(
        self, name: str, request: str, former: bytes, peer: str = "10.113.11.2"
    ) -> Coroutine[Any, Any, NewCertificate]:
        return self.hosts.itself.renew(HostRenewItself(name, request, sign(former, request), peer))

    def renewed(self, name: str) -> Coroutine[Any, Any, Any]:
        return self.hosts.itself.renewed(HostRenewed(name, "10.113.11.2"))

    def recorded(self, event: str) -> list[str]:
        return [fields["reason"] for name, fields in self.trail.heard if name == event]

    def _said(self, message: Message) -> None:
        self.asked.append(message)
        self.tunnels.answered(self.answer)

    async def _carried_out(self) -> None:
        await self.relays.wait()

    async def _endpoint(self) -> Endpoint:
        return Endpoint("10.0.0.1", "it is")

    def _changed(self) -> int:
        self.order.append(f"policy {sorted(self.tunnels.addresses)}")
        return 1

    def _expel(self, address: Address, reason: str) -> int:
        self.order.append(f"expel {address}")
        return 2


def sign(key: bytes, request: str) -> bytes:
    private = load_pem_private_key(key, None)
    assert isinstance(private, ec.EllipticCurvePrivateKey)
    return private.sign(request.encode(), ec.ECDSA(hashes.SHA384()))


def request_of(name: str) -> str:
    return signing_request(make_key(), name).decode()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    yield bench
    bench.close()


@pytest.fixture(autouse=True)
def nobody_waits_for_charon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("appliance.hosts.tunnel_state._TAKEN_SECONDS", 0.0)


def run(directory: Path, work: Callable[[Bench], Coroutine[Any, Any, None]], **options: Any) -> None:
    async def inside() -> None:
        bench = Bench(directory, **options)
        try:
            await work(bench)
        finally:
            bench.close()

    asyncio.run(inside())


async def test_addresses_are_given_in_order_and_kept(bench: Bench) -> None:
    bench.declared.write_text("hosts:\n  - name: laptop\n    address: 10.113.11.3\n")
    await bench.reload()
    assert (await bench.add("a")).address == "10.113.11.2"
    assert (await bench.add("b")).address == "10.113.11.4"
    assert (await bench.add("laptop")).address == "10.113.11.3"
    await bench.revoke("a")
    assert (await bench.add("c")).address == "10.113.11.5"
    assert (await bench.add("a")).address == "10.113.11.2"
    assert (await bench.add("d")).address == "10.113.11.6"
    with pytest.raises(HostRefusedError, match=r"set a larger ipsec\.pool"):
        await bench.add("e")


@pytest.mark.parametrize(
    ("name", "address", "why"),
    [
        *(("b", taken, "address") for taken in ("10.113.11.1", "10.113.12.2", "10.113.11", "::1", "10.113.11.2")),
        *((wrong, None, "not a valid host name")
          for wrong in ("", "rosrv-appliance", "ROSRV-Appliance", "a b", "../a", "x" * 64, "a\n")),
        *((other, None, "letter case") for other in ("Laptop", "LAPTOP")),
    ],
)  # fmt: skip
async def test_an_unavailable_name_or_address_is_refused(
    bench: Bench, name: str, address: str | None, why: str
) -> None:
    """The appliance's name is reserved, and names must differ in more than case, as in IKE."""
    await bench.add("laptop")
    with pytest.raises(HostRefusedError, match=why):
        await bench.hosts.add(
            HostAdd(name, "" if why == "not a valid host name" else request_of("b"), 90, address), "tester"
        )


def test_without_a_firewall_no_name_stands_for_an_address(tmp_path: Path) -> None:
    async def enrol(bench: Bench) -> None:
        await bench.add("a")
        assert list(bench.tunnels.addresses) == ["a"]

    async def again(bench: Bench) -> None:
        bench.answer = TunnelsEnclosed(None, "no firewall here")
        await bench.tunnels.start()
        assert isinstance(bench.asked[0], TunnelsWanted)
        assert bench.tunnels.addresses == {}
        assert "no firewall here" in bench.hosts.status().troubles[0]
        with pytest.raises(HostRefusedError, match="no firewall here"):
            await bench.add("b")

    run(tmp_path, enrol)
    run(tmp_path, again)


def test_no_host_keeps_an_address_outside_the_pool(tmp_path: Path) -> None:
    """It could be anyone's, in clear text: so the name matches no host, until the host has another address."""
    tokens = []

    async def enrol(bench: Bench) -> None:
        for name in ("a", "gone"):
            await bench.add(name)
        tokens.append((await bench.token("late", seconds=3600)).token)
        await bench.revoke("gone")

    async def after(bench: Bench) -> None:
        await bench.tunnels.start()
        found = bench.table.admitted_hosts(), bench.tunnels.addresses, bench.table.at("10.113.11.2")
        assert found == ([], {}, None)
        why = "a has 10.113.11.2, outside ipsec.pool (10.113.12.0/29), and cannot connect"
        assert why in bench.hosts.status().troubles[0]
        with pytest.raises(HostRefusedError, match="rosrv host kit a gives it another address"):
            await bench.hosts.kit(HostKit("a"))
        with pytest.raises(HostForbiddenError):
            await bench.hosts.itself.renewed(HostRenewed("a", "10.113.11.2"))
        kit = await bench.renew("a")
        assert (kit.address, kit.appliance) == ("10.113.12.2", "10.113.12.1")
        assert {name: str(address) for name, address in bench.tunnels.addresses.items()} == {"a": kit.address}
        assert bench.hosts.status().troubles == []
        assert (await bench.enrol(tokens[0], "late")).address == "10.113.12.3"
        assert (await bench.add("gone")).address == "10.113.12.4"

    run(tmp_path, enrol)
    run(tmp_path, after, pool="10.113.12.0/29")


def test_a_master_that_tunnels_cannot_reach_is_reported(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        with pytest.raises(HostRefusedError, match=r"listen: 0\.0\.0\.0:11311"):
            await bench.add("a")

    run(tmp_path, work, listen="192.168.1.20")


async def test_a_revoked_host_leaves_the_policy_first(bench: Bench) -> None:
    await bench.add("a")
    bench.order.clear()
    body = await bench.revoke("a")
    assert bench.order == ["policy []", "expel 10.113.11.2"]
    assert body.taken_back == 3
    assert [row.serial for row in bench.store.hosts.revoked_certificates()] == [body.serial]
    with pytest.raises(HostRefusedError, match="enrol it: rosrv host add NAME"):
        await bench.revoke("a")


async def test_a_new_certificate_revokes_the_one_before(bench: Bench) -> None:
    first = await bench.add("a")
    with pytest.raises(HostRefusedError, match="rosrv host kit a"):
        await bench.add("a")
    second = await bench.renew("a")
    assert second.address == first.address
    assert [row.serial for row in bench.store.hosts.revoked_certificates()] == [first.serial]


async def test_a_bad_request_enrols_no_host(bench: Bench) -> None:
    with pytest.raises(HostRefusedError, match="not a signing request"):
        await bench.hosts.add(HostAdd("a", "rubbish", 90), "tester")
    assert bench.hosts.rows() == []


async def test_divergences_from_the_declared_hosts_are_listed(bench: Bench) -> None:
    bench.declared.write_text("hosts:\n  - name: laptop\n")
    await bench.reload()
    await bench.add("a")
    rows = {row.name: (row.state, row.declared) for row in bench.hosts.rows()}
    assert rows == {"a": ("down", False), "laptop": ("not enrolled", True)}
    bench.declared.write_text("hosts: [")
    with pytest.raises(HostRefusedError, match="the previous declaration stays in force"):
        await bench.reload()
    assert [row.name for row in bench.hosts.rows()] == ["a", "laptop"]
    assert any("hosts.yaml" in trouble for trouble in bench.hosts.status().troubles)


async def test_a_one_time_token_enrols_once(bench: Bench, tmp_path: Path) -> None:
    first = await bench.token("a")
    second = await bench.token("a")
    for text in (first.token, "rosrv-enrol_000000000000_" + "x" * 43, "rubbish"):
        with pytest.raises(HostForbiddenError, match="wrong, already used, or expired"):
            await bench.enrol(text, "a")
    assert bench.hosts.rows()[0].state == "awaited"
    body = await bench.enrol(second.token, "a")
    assert body.address == second.address
    assert body.kept["endpoint"] == "10.0.0.1"
    with pytest.raises(HostForbiddenError):
        await bench.enrol(second.token, "a")
    secret = second.token.split("_", 2)[2].encode()
    for file in tmp_path.rglob("*"):
        if file.is_file():
            assert secret not in file.read_bytes(), file


@pytest.mark.parametrize("new", [True, False])
def test_a_host_that_lost_the_answer_gets_it_again(tmp_path: Path, *, new: bool) -> None:
    request, token = request_of("a"), []

    async def first(bench: Bench) -> None:
        if not new:
            await bench.add("a")
        token.append((await bench.token("a", new=new)).token)
        await bench.hosts.itself.enrol(HostEnrol(token[0], request, "10.9.9.9"))
        assert bench.hosts.rows()[0].state != "awaited"

    async def again(bench: Bench) -> None:
        given = HostEnrol(token[0], request, "10.9.9.9")
        present = bench.hosts.rows()[0].serial
        kit = await bench.hosts.itself.enrol(given)
        assert (kit.serial, kit.kept["endpoint"]) == (present, "10.0.0.1")
        assert len(bench.store.hosts.revoked_certificates()) == (not new)
        with pytest.raises(HostForbiddenError, match="already used"):  # with another key
            await bench.enrol(token[0], "a")

    run(tmp_path, first)
    run(tmp_path, again)


@pytest.mark.parametrize("by", ["a new kit", "a new token", "a revocation", "its end"])
async def test_a_used_token_ends(bench: Bench, by: str) -> None:
    machine = VirtualClock()
    with using(machine):
        given = HostEnrol((await bench.token("a")).token, request_of("a"), "10.9.9.9")
        assert await bench.hosts.itself.enrol(given)
        assert await bench.hosts.itself.enrol(given)
        match by:
            case "a new kit":
                await bench.renew("a")
            case "a new token":
                await bench.token("a", new=False)
            case "a revocation":
                await bench.revoke("a")
            case _:
                machine.advance(61)
        with pytest.raises(HostForbiddenError, match="already used, or expired"):
            await bench.hosts.itself.enrol(given)


async def test_two_simultaneous_uses_of_a_token_get_one_certificate(bench: Bench) -> None:
    text = (await bench.token("a")).token
    both = await asyncio.gather(
        bench.hosts.itself.enrol(HostEnrol(text, request_of("a"), "10.9.9.8")),
        bench.enrol(text, "a"),
        return_exceptions=True,
    )
    assert sorted(isinstance(one, HostForbiddenError) for one in both) == [False, True]


async def test_a_bad_request_does_not_use_the_token_up(bench: Bench) -> None:
    text = (await bench.token("a")).token
    with pytest.raises(HostRefusedError, match="not a signing request"):
        await bench.hosts.itself.enrol(HostEnrol(text, "rubbish", "10.9.9.9"))
    await bench.enrol(text, "a")
    short = (await bench.token("b", seconds=0.05)).token
    await asyncio.sleep(0.06)
    with pytest.raises(HostForbiddenError):
        await bench.enrol(short, "b")
    taken_back = (await bench.token("c")).token
    assert (await bench.revoke("c")).serial == ""
    with pytest.raises(HostForbiddenError):
        await bench.enrol(taken_back, "c")


def test_tokens_outlive_a_restart(tmp_path: Path) -> None:
    texts: list[str] = []

    async def before(bench: Bench) -> None:
        texts.append((await bench.token("a")).token)

    async def after(bench: Bench) -> None:
        assert (await bench.enrol(texts[0], "a")).name == "a"

    run(tmp_path, before)
    run(tmp_path, after)


@pytest.mark.parametrize("how", ["kit", "token", "itself"])
async def test_revoked_while_a_certificate_is_made(bench: Bench, how: str) -> None:
    key = make_key()
    await bench.add("a", key=key)
    text = (await bench.token("a", new=False)).token
    tasks: list[asyncio.Task[Any]] = []

    def revoke() -> None:
        bench.authority.meanwhile = lambda: None
        tasks.append(asyncio.get_running_loop().create_task(bench.revoke("a")))

    bench.authority.meanwhile = revoke
    request = request_of("a")
    with pytest.raises(HostForbiddenError, match="revoked in the meantime"):
        if how == "kit":
            await bench.hosts.renew(HostRenew("a", request, 90), "tester")
        elif how == "token":
            await bench.hosts.itself.enrol(HostEnrol(text, request, "10.9.9.9"))
        else:
            await bench.renew_itself("a", request, key)
    await asyncio.gather(*tasks)
    assert bench.hosts.rows()[0].state == "revoked"
    assert bench.tunnels.addresses == {}


@pytest.mark.parametrize("how", ["kit", "token"])
@pytest.mark.parametrize("when", ["before the tunnels are open", "while its certificate is made"])
async def test_revoked_before_the_first_enrolment_ends(bench: Bench, how: str, when: str) -> None:
    """The operator is not told that there is no such host, and the log has who ended it, and that it ended."""
    text = (await bench.token("a")).token if how == "token" else ""
    revoked: list[asyncio.Task[Revoked]] = []

    def revoke() -> None:
        bench.authority.meanwhile = lambda: None
        revoked.append(asyncio.get_running_loop().create_task(bench.revoke("a")))

    opening = bench.tunnels.open

    async def open_late() -> None:
        if when == "before the tunnels are open":
            revoke()
            await asyncio.sleep(1)
        await opening()

    bench.tunnels.open = open_late  # type: ignore[method-assign]  # the supervisor may take 20 seconds
    if when == "while its certificate is made":
        bench.authority.meanwhile = revoke
    with pytest.raises(HostForbiddenError, match="revoked in the meantime"):
        await (bench.enrol(text, "a") if how == "token" else bench.add("a"))
    (task,) = revoked
    said = await task
    assert (said.name, said.address, said.serial) == ("a", "10.113.11.2", "")
    assert "a was revoked while it was being enrolled" in bench.recorded("host awaited no longer")
    assert len(bench.recorded("enrolment refused")) == (how == "token")
    assert (bench.table.rows, bench.hosts.rows()) == ({}, [])


async def test_a_host_renews_itself(bench: Bench) -> None:
    key = make_key()
    first = await bench.add("a", key=key)
    request = request_of("a")
    made = await bench.hosts.itself.renew(
        HostRenewItself("a", request, sign(key, request), "::ffff:10.113.11.2")
    )
    assert made.serial != first.serial
    assert bench.hosts.rows()[0].renewing
    assert bench.store.hosts.revoked_certificates() == []
    await bench.renewed("a")
    assert [row.serial for row in bench.store.hosts.revoked_certificates()] == [first.serial]
    assert bench.hosts.rows()[0].serial == made.serial
    with pytest.raises(HostRefusedError, match="renew first"):
        await bench.renewed("a")
    with pytest.raises(HostRefusedError, match="again in"):
        await bench.renew_itself("a", request, key)


def test_renewals_make_a_host_wait_over_restarts(tmp_path: Path) -> None:
    keys = [make_key() for _ in range(3)]

    async def first(bench: Bench) -> None:
        await bench.add("a", key=keys[0])
        request = signing_request(keys[1], "a").decode()
        await bench.renew_itself("a", request, keys[0])
        await bench.renewed("a")

    async def second(bench: Bench) -> None:
        await bench.tunnels.start()
        request = signing_request(keys[2], "a").decode()
        with pytest.raises(HostRefusedError, match="again in 4 days"):
            await bench.renew_itself("a", request, keys[1])
        await bench.hosts.renew(HostRenew("a", request, 90), "tester")

    run(tmp_path, first)
    run(tmp_path, second)


async def test_a_short_life_needs_a_short_wait(bench: Bench) -> None:
    keys = [make_key(), make_key(), make_key()]
    await bench.hosts.add(HostAdd("a", signing_request(keys[0], "a").decode(), 100 / 86_400), "tester")
    machine = VirtualClock()
    with using(machine):
        for former, key in itertools.pairwise(keys):
            request = signing_request(key, "a").decode()
            await bench.renew_itself("a", request, former)
            await bench.renewed("a")
            machine.advance(6)


async def test_a_host_renews_only_its_own_certificate(bench: Bench) -> None:
    key, other = make_key(), make_key()
    await bench.add("a", key=key)
    await bench.add("b", key=other)
    request = request_of("a")
    good = sign(key, request)
    for name, peer in (
        ("a", "192.168.1.5"), ("a", "10.113.11.3"), ("zz", "10.113.11.2"), ("b", "10.113.11.2")
    ):  # fmt: skip
        with pytest.raises(HostForbiddenError):
            await bench.hosts.itself.renew(HostRenewItself(name, request, good, peer))
        with pytest.raises(HostForbiddenError):
            await bench.hosts.itself.renewed(HostRenewed(name, peer))
    with pytest.raises(HostRefusedError, match="not signed by the key"):
        await bench.renew_itself("a", request, other)
    assert len(bench.recorded("renewal refused")) == 8
    bench.tunnels.answered(TunnelsEnclosed(None, "the firewall is gone"))
    with pytest.raises(HostForbiddenError):
        await bench.hosts.itself.renew(HostRenewItself("a", request, good, "10.113.11.2"))


async def test_revoking_during_a_renewal_revokes_both_certificates(bench: Bench) -> None:
    key = make_key()
    first = await bench.add("a", key=key)
    request = request_of("a")
    made = await bench.renew_itself("a", request, key)
    await bench.revoke("a")
    assert {row.serial for row in bench.store.hosts.revoked_certificates()} == {first.serial, made.serial}
    with pytest.raises(HostForbiddenError):
        await bench.renewed("a")
    again = await bench.add("a")
    assert again.address == first.address
    assert again.serial not in {first.serial, made.serial}


async def test_the_list_is_signed_once_however_often_it_is_asked_for(bench: Bench) -> None:
    first = await bench.add("a")
    assert "BEGIN CERTIFICATE" in (await bench.certification.authority(AuthorityWanted())).authority
    assert bench.authority.lists == 0
    answers = await asyncio.gather(*(bench.certification.revocations(RevocationsWanted()) for _ in range(20)))
    assert bench.authority.lists == 1
    assert len({answer.revocations for answer in answers}) == 1
    await bench.revoke("a")
    after = x509.load_pem_x509_crl(
        (await bench.certification.revocations(RevocationsWanted())).revocations.encode()
    )
    assert [f"{one.serial_number:x}" for one in after] == [first.serial]
    assert bench.authority.lists == 2


async def test_a_full_list_replaces_no_certificate(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("appliance.hosts.appliances.ENTRIES_BYTES", 120)
    for name in ("a", "b"):
        await bench.add(name)
    for _ in range(2):
        await bench.renew("a")
    key_before = bench.hosts.rows()[1].serial
    with pytest.raises(HostRefusedError, match=r"list of revoked certificates is full.*before 2"):
        await bench.renew("b")
    assert bench.hosts.rows()[1].serial == key_before
    await bench.add("c")
    await bench.revoke("a")
    await bench.renew("b")
    assert bench.hosts.status().troubles == []


async def test_a_change_for_another_state_is_refused(bench: Bench) -> None:
    seen = (await bench.hosts.list_hosts(HostList())).revision
    await bench.add("a")
    for late in (
        bench.hosts.revoke(HostRevoke("a", seen), "tester"),
        bench.hosts.renew(HostRenew("a", request_of("a"), 90, seen), "tester"),
        bench.hosts.ports.tell(HostPorts("a", "closed", [], 1.0, seen), "tester"),
        bench.hosts.reload(HostsReload(seen), "tester"),
    ):
        with pytest.raises(HostsChangedError):
            await late
    await bench.hosts.revoke(HostRevoke("a", (await bench.hosts.list_hosts(HostList())).revision), "tester")


@pytest.mark.parametrize("name", ["a.b-c_d", "0", "x" * 63, "con.fig", "host-a"])
async def test_odd_names_that_are_names(bench: Bench, name: str) -> None:
    await bench.add(name)
    assert bench.hosts.rows()[0].name == name
    await bench.revoke(name)


def test_two_hundred_hosts(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        request = request_of("x")
        for number in range(200):
            await bench.hosts.add(HostAdd(f"h{number}", request, 1), "tester")
        assert len({row.address for row in bench.hosts.rows()}) == 200

    async def again(bench: Bench) -> None:
        assert len(bench.hosts.rows()) == 200
        assert len(bench.table.admitted_hosts()) == 200

    run(tmp_path, work, pool="10.113.0.0/16")
    run(tmp_path, again, pool="10.113.0.0/16")


async def test_a_tunnel_that_is_not_wanted_stays_closed(bench: Bench) -> None:
    await bench.add("a")
    await bench.add("b")
    bench.order.clear()
    bench.declared.write_text("hosts:\n  - {name: a, tunnel: false, groups: [ocu]}\n  - name: c\n")
    body = await bench.reload()
    assert bench.order == ["policy ['b']", "expel 10.113.11.2"]
    assert (body.closed, body.opened) == (["a"], [])
    assert body.divergence == ["b: enrolled, not in hosts.yaml", "c: in hosts.yaml, not enrolled"]
    rows = {row.name: row for row in bench.hosts.rows()}
    assert (rows["a"].state, rows["a"].groups, rows["b"].state) == ("not wanted", ["ocu"], "down")
    bench.declared.unlink()
    assert (await bench.reload()).opened == ["a"]
    assert sorted(bench.tunnels.addresses) == ["a", "b"]


def test_the_first_tunnel_that_is_wanted_counts_in_the_policy(tmp_path: Path) -> None:
    async def enrol(bench: Bench) -> None:
        await bench.add("a")

    async def again(bench: Bench) -> None:
        await bench.tunnels.start()
        assert not bench.asked
        bench.declared.unlink()
        body = await bench.reload()
        assert body.opened == ["a"]
        assert list(bench.tunnels.addresses) == ["a"]
        assert bench.order[-1] == "policy ['a']"
        bench.order.clear()
        await bench.reload()
        assert not bench.order

    run(tmp_path, enrol)
    (tmp_path / "hosts.yaml").write_text("hosts:\n  - {name: a, tunnel: false}\n")
    run(tmp_path, again)


async def test_a_certificate_that_ends_soon_and_its_end_are_logged_once(bench: Bench) -> None:
    """Each record has the words of the present trouble; a certificate that has ended does not end soon."""
    with using(machine := VirtualClock()):
        await bench.hosts.add(HostAdd("short", request_of("a"), 40), "tester")
        assert bench.hosts.status().troubles == []
        for days, event, text, is_soon in (
            (30, "certificate ends soon", "expires in 10 days and was not renewed", True),
            (11, "certificate ended", "has expired", False),
        ):
            machine.set_wall(clock.wall() + days * 86_400.0)
            bench.each_hour()
            bench.each_hour()
            assert bench.recorded(event) == [f"the certificate of short {text}: rosrv host kit short"]
            assert bench.hosts.status().troubles == bench.recorded(event)
            assert [host.expires_soon for host in bench.hosts.rows()] == [is_soon]


async def test_scanned_ports_of_a_host_are_kept(bench: Bench) -> None:
    await bench.add("a")
    bench.machines = {"10.0.0.7": 3, "127.0.0.1": 1, "10.113.11.2": 2}
    assert (await bench.hosts.ports.tell(HostPorts("10.113.11.2", "open", [40001], 5.0), "eve")).name == "a"
    await bench.hosts.ports.tell(HostPorts("10.0.0.7", "closed", [], 6.0), "eve")
    with pytest.raises(HostRefusedError, match="the enrolled hosts: a"):
        await bench.hosts.ports.tell(HostPorts("nobody", "open", [], 5.0), "eve")
    with pytest.raises(HostRefusedError, match="a day in the future"):
        await bench.hosts.ports.tell(HostPorts("a", "closed", [], 4e9), "eve")
    overview = await bench.hosts.list_hosts(HostList())
    assert overview.hosts[0].ports == PortsSeen("open", 5.0, [40001], "eve")
    assert [(machine.address, machine.nodes, machine.ports.state) for machine in overview.machines] == [
        ("10.0.0.7", 3, "closed")
    ]


async def test_an_alarm_about_open_ports_names_the_host_as_the_policy_does(bench: Bench) -> None:
    bench.machines = {"10.0.0.7": 3}
    await bench.hosts.ports.tell(HostPorts("10.0.0.7", "open", [40001], 5.0), "eve")
    (trouble,) = bench.hosts.status().troubles
    assert trouble.startswith("ROS ports of tablet (10.0.0.7) are open to hosts other than the appliance")
    assert "the ROS ports of tablet (10.0.0.7) are open: [40001]" in str(bench.recorded("ports checked"))


@pytest.mark.parametrize("order", [HostRevoke("a"), HostsReload()], ids=["revoke", "reload"])
async def test_removing_a_host_answers_once_its_connections_are_closed(
    bench: Bench, order: HostRevoke | HostsReload
) -> None:
    await bench.add("a")
    bench.relays.clear()
    hosts = bench.hosts
    asked = asyncio.ensure_future(
        hosts.revoke(order, "alice") if isinstance(order, HostRevoke) else hosts.reload(order, "alice")
    )
    await bench.store.until_settled()
    for _ in range(10):
        await asyncio.sleep(0)
    assert not asked.done()
    bench.relays.set()
    await asked


Stated = asyncio.Queue[TunnelsStated]


@contextlib.asynccontextmanager
async def stated_to(bench: Bench, link: Channel, charon: Channel) -> AsyncIterator[Stated]:
    """Let a charon of a new key connect, and yield the configurations that it gets."""
    stated = Stated()

    def heard(message: Message, _descriptors: tuple[int, ...]) -> None:
        if isinstance(message, TunnelsStated):
            stated.put_nowait(message)

    charon.attach(asyncio.get_running_loop(), heard, lambda: None)
    bench.tunnels.attach(link)
    running = asyncio.create_task(bench.tunnels.run(lambda: None))
    key = make_key()
    charon.send(CertificateNeeded(signing_request(key, "rosrv-appliance"), fingerprint(key)))
    yield stated
    running.cancel()
    for one in (link, charon):
        one.close()


def connected() -> tuple[Channel, Channel]:
    ours, theirs = socket.socketpair()
    return Channel(ours, TunnelLink), Channel(theirs, TunnelLink)


@pytest.mark.nightly
async def test_only_configurations_of_this_control_count_as_taken(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("appliance.hosts.tunnel_state._TAKEN_SECONDS", 0.05)
    link, charon = connected()
    await bench.add("a")
    async with stated_to(bench, link, charon) as stated:
        number = (await stated.get()).number
        charon.send(TunnelsReported(number + 3_600_000_000_000, []))
        assert not await bench.tunnels.until_taken()
        charon.send(TunnelsReported(number, []))
        monkeypatch.setattr("appliance.hosts.tunnel_state._TAKEN_SECONDS", 30.0)
        assert await bench.tunnels.until_taken()


@pytest.mark.nightly
async def test_the_tunnel_of_a_blocked_host_is_closed_until_the_block_ends(bench: Bench) -> None:
    link, charon = connected()
    for name in ("a", "b"):
        await bench.add(name)
    async with stated_to(bench, link, charon) as stated:

        async def names() -> list[str]:
            return [host.name for host in (await stated.get()).hosts]

        assert await names() == ["a", "b"]
        for blocked, left in ((True, ["b"]), (False, ["a", "b"])):
            bench.blocked = {bench.tunnels.addresses["a"]} if blocked else set()
            bench.tunnels.state_anew()
            assert await names() == left
        bench.blocked = {ipaddress.ip_address("192.0.2.20")}
        charon.send(TunnelChanged("b", True, "192.0.2.20"))  # its real address is blocked
        assert await names() == ["a"]
        charon.send(TunnelsReported(0, []))  # it is down, and may not return from elsewhere
        charon.send(TunnelChanged("a", True, "192.0.2.21"))
        bench.tunnels.state_anew()
        assert await names() == ["a"]
        bench.blocked = set()
        bench.tunnels.state_anew()
        assert await names() == ["a", "b"]


async def test_charon_has_a_valid_certificate_and_list_soon_after_a_step_of_the_clock(bench: Bench) -> None:
    await bench.add("a")
    with using(machine := VirtualClock()):
        check = ClockCheck(bench.trail, lambda: 0.0, stepped=bench.tunnels.state_anew)
        async with stated_to(bench, *memory_link(TunnelLink)) as stated:
            first = await stated.get()
            # The list of revoked certificates is valid for 30 days.
            for days, same in ((40, True), (60, False)):
                machine.set_wall(clock.wall() + days * 86_400.0)
                check.look()
                now = clock.utc_now()
                while (last := await stated.get()).revocations == first.revocations:
                    pass
                if not same:
                    while last.certificate == first.certificate:
                        last = await stated.get()
                listed_until = x509.load_pem_x509_crl(last.revocations).next_update_utc
                assert listed_until is not None and listed_until > now
                assert x509.load_pem_x509_certificate(last.certificate).not_valid_after_utc > now
                assert (last.certificate == first.certificate) is same
                first = last


async def test_a_host_that_enrolled_while_the_clock_was_ahead_is_named(bench: Bench) -> None:
    with using(machine := VirtualClock()):
        now = clock.wall()
        machine.set_wall(now + 7 * 86_400.0)
        await bench.add("a")
        assert bench.hosts.status().troubles == []
        machine.set_wall(now)
        (trouble,) = bench.hosts.status().troubles
        assert trouble.startswith("the certificate of a was made while the clock was ahead")
        await bench.renew("a")
        assert bench.hosts.status().troubles == []


async def test_a_host_that_enrolled_before_the_clock_was_set_can_renew(bench: Bench) -> None:
    first, second = make_key(), make_key()
    with using(machine := VirtualClock(wall=10.0)):
        await bench.add("a", key=first)
        machine.set_wall(Path(shipped.__file__).stat().st_mtime + 30 * 86_400.0)
        made = await bench.renew_itself("a", signing_request(second, "a").decode(), first)
        assert made.expires == pytest.approx(clock.wall() + 90 * 86_400.0, abs=86_400.0)


def test_a_full_disk_during_enrolment_names_the_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def full() -> None:
        raise StoreError("state.db: full; make room")

    async def work(bench: Bench) -> None:
        with monkeypatch.context() as patched:
            patched.setattr(bench.store, "until_settled", full)
            with pytest.raises(
                StoreError, match=r"^state\.db: full; make room; .*no kit: rosrv host kit a, or revoke"
            ):
                await bench.add("a")
        await bench.renew("a")

    run(tmp_path, work)


def test_without_the_authoritys_key_changes_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    key, request = make_key(), request_of("a")

    async def first(bench: Bench) -> None:
        await bench.add("a", key=key)
        await bench.add("b")
        await bench.renew_itself("a", request, key)

    async def second(bench: Bench) -> None:
        await bench.tunnels.start()
        for order in (bench.add("c"), bench.renewed("a"), bench.renew("b")):
            with pytest.raises(HostRefusedError, match="new certificates wait") as caught:
                await order
            assert caught.value.ours
        assert bench.store.hosts.revoked_certificates() == []
        await bench.revoke("b")
        assert [row.name for row in bench.table.hosts()] == ["a"]

    async def obstacle(_authority: StoredAuthority) -> str:
        return "new certificates wait"

    run(tmp_path, first)
    monkeypatch.setattr(StoredAuthority, "obstacle", obstacle)
    run(tmp_path, second)


async def test_a_kit_of_two_appliances_has_both(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Appliances, "paired", True)
    await bench.add("a")
    kit = await bench.certification.kit("a", None)
    assert kit.second == ""
    assert "later, rosrv host kit a" in (kit.warning or "")
    monkeypatch.setattr(Appliances, "other", ApplianceRow("key", "192.168.1.21", "sha256//B", "", "1f", 1.0))
    kit = await bench.certification.kit("a", None)
    assert (kit.second, kit.pin, kit.warning) == ("192.168.1.21", "sha256//pin;sha256//B", None)
