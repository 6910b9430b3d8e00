import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509

from appliance.base.clock import using
from appliance.features.standby import paired_role
from appliance.features.standby.paired_role import ApplianceTable, SharedAuthority
from appliance.features.standby.replication_frames import Introduction
from appliance.hosts.appliances import Appliances, RevokedCertificates
from appliance.hosts.certificate_requests import AuthorityError, StoredAuthority
from appliance.ipsec.requests import fingerprint, make_key, signing_request
from appliance.store.state_file import StateStore
from tests.support.engines import InlineDatabase
from tests.support.near_authority import NearAuthority
from tests.support.virtual_clock import VirtualClock

pytestmark = pytest.mark.anyio

FIRST, SECOND = "10.0.0.2", "10.0.0.3"
PIN = "sha256//" + 43 * "A" + "="


@pytest.fixture
def store(tmp_path: Path) -> Iterator[StateStore]:
    opened = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    yield opened
    opened.close()


def near(tmp_path: Path, name: str) -> NearAuthority:
    (tmp_path / name).mkdir(exist_ok=True)
    return NearAuthority(tmp_path / name)


def introduction(endpoint: str = SECOND, key: bytes | None = None) -> Introduction:
    key = key or make_key()
    return Introduction(signing_request(key, "rosrv-appliance"), fingerprint(key), endpoint, PIN)


def table(store: StateStore, endpoint: str = FIRST) -> ApplianceTable:
    return ApplianceTable(store.hosts, RevokedCertificates(store.hosts), endpoint)


async def test_the_second_appliance_opens_tunnels_and_issues_nothing(
    tmp_path: Path, store: StateStore
) -> None:
    first = SharedAuthority(near(tmp_path, "a"), store.hosts)
    certificate, listed = await first.certificate(), await first.revocations([("1f", 1.0)])
    assert await first.obstacle() == first.waits == ""
    second = SharedAuthority(near(tmp_path, "b"), store.hosts)
    assert await second.certificate() == certificate
    assert await second.revocations([("1f", 1.0), ("2f", 2.0)]) == listed
    with pytest.raises(AuthorityError, match=r"new certificates wait, .*\(rosrv standby switch\)") as caught:
        await second.issue(signing_request(make_key(), "ocu-1"), "ocu-1", 1)
    assert not caught.value.refused


async def test_the_end_of_the_last_list_is_shown(tmp_path: Path, store: StateStore) -> None:
    listed = await SharedAuthority(near(tmp_path, "a"), store.hosts).revocations([])
    end = x509.load_pem_x509_crl(listed).next_update_utc
    assert end is not None
    other = near(tmp_path, "b")
    other.trouble = "ca.key cannot be decrypted"
    second = SharedAuthority(other, store.hosts)
    await second.obstacle()
    assert f"tunnels open until {end:%Y-%m-%d %H:%M}Z" in second.waits
    assert "(ca.key cannot be decrypted)" in second.waits


async def test_a_single_appliance_uses_its_own_key(tmp_path: Path, store: StateStore) -> None:
    await SharedAuthority(near(tmp_path, "a"), store.hosts).revocations([])
    own = near(tmp_path, "b")
    alone = StoredAuthority(own, store.hosts)
    assert await alone.certificate() == (await own.statement()).certificate
    assert await alone.obstacle() == ""


async def test_another_authority_is_reported_once(tmp_path: Path, store: StateStore) -> None:
    told: list[str] = []
    for name in ("a", "a", "b", "b"):
        alone = StoredAuthority(
            near(tmp_path, name), store.hosts, replaced=lambda *_certificates: told.append("new")
        )
        await alone.certificate()
        await alone.certificate()
    assert told == ["new"]


async def test_without_a_list_no_tunnel_opens(tmp_path: Path, store: StateStore) -> None:
    await SharedAuthority(near(tmp_path, "a"), store.hosts).certificate()
    second = SharedAuthority(near(tmp_path, "b"), store.hosts)
    with pytest.raises(AuthorityError, match="no list of revoked certificates was signed yet"):
        await second.revocations([])


async def test_the_standby_finds_its_certificate_in_the_state(tmp_path: Path, store: StateStore) -> None:
    authority = SharedAuthority(near(tmp_path, "a"), store.hosts)
    first, given = table(store), introduction()
    await first.introduce(given, authority)
    certificate = first.certificate(given.key)
    x509.load_pem_x509_certificate(certificate).verify_directly_issued_by(
        x509.load_pem_x509_certificate(await authority.certificate())
    )
    await first.introduce(given, authority)
    assert first.certificate(given.key) == certificate
    assert first.other is not None
    assert (first.other.endpoint, first.other.pin) == (SECOND, PIN)
    second = table(store, SECOND)
    assert second.certificate(given.key) == certificate
    assert second.certificate("0" * 64) == b""
    assert second.other is None


async def test_a_certificate_is_renewed_long_before_its_end(
    tmp_path: Path, store: StateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    authority, first, given = (
        SharedAuthority(near(tmp_path, "a"), store.hosts), table(store), introduction(),
    )  # fmt: skip
    monkeypatch.setattr(paired_role, "CERTIFICATE_DAYS", 59.0)
    await first.introduce(given, authority)
    before = first.certificate(given.key)
    monkeypatch.setattr(paired_role, "CERTIFICATE_DAYS", 90.0)
    await first.introduce(given, authority)
    assert first.certificate(given.key) not in (b"", before)
    with using(VirtualClock(wall=4e9)):
        assert first.certificate(given.key) == b""


async def test_a_replaced_appliance_is_revoked(
    tmp_path: Path, store: StateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    authority, first = SharedAuthority(near(tmp_path, "a"), store.hosts), table(store)
    stolen, replacement, further = introduction(), introduction(), introduction()
    await first.introduce(stolen, authority)
    await first.introduce(replacement, authority)
    assert first.certificate(replacement.key) == b""
    monkeypatch.setattr(paired_role, "_REPLACED_SECONDS", 0.0)
    await first.introduce(replacement, authority)
    await first.introduce(further, authority)
    assert first.certificate(stolen.key) == first.certificate(replacement.key) == b""
    assert first.certificate(further.key)
    assert len(store.hosts.revoked_certificates()) == 2
    Appliances(store.hosts, RevokedCertificates(store.hosts))
    assert store.hosts.appliances() == []
    assert len(store.hosts.revoked_certificates()) == 3


async def test_an_appliance_with_the_same_address_is_not_taken(tmp_path: Path, store: StateStore) -> None:
    authority, first = SharedAuthority(near(tmp_path, "a"), store.hosts), table(store)
    await first.introduce(introduction(FIRST), authority)
    assert first.other is None
    assert store.hosts.appliances() == []


async def test_a_flood_of_introductions_is_one_at_a_time(tmp_path: Path, store: StateStore) -> None:
    signer, first = near(tmp_path, "a"), table(store)
    authority, issued = SharedAuthority(signer, store.hosts), []
    signer.meanwhile = lambda: issued.append(1)
    await asyncio.gather(*(first.introduce(introduction(), authority) for _ in range(20)))
    assert len(issued) == 1


async def test_each_appliance_knows_its_own_row(tmp_path: Path, store: StateStore) -> None:
    signer, key = near(tmp_path, "a"), make_key()
    first = table(store)
    made = await signer.issue(signing_request(key, "rosrv-appliance"), "rosrv-appliance", 90)
    first.certified(fingerprint(key), made)
    first.is_served(PIN)
    assert first.other is None
    second = table(store, SECOND)
    second.note_own("0" * 64)
    assert second.other is not None
    assert (second.other.endpoint, second.other.pin) == (FIRST, PIN)
