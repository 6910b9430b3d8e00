import contextlib
import itertools
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from appliance.base import clock
from appliance.base.clock import using
from appliance.hosts.appliances import RevokedCertificates
from appliance.ipsec.certificate_authority import CertificateAuthority
from appliance.store.state_file import StateStore
from tests.support.engines import InlineDatabase
from tests.support.virtual_clock import VirtualClock

DAY = 86_400.0
LONGEST = 65_535  # bytes of a value of vici
_NUMBERS = itertools.count(1 << 70)


def serials(count: int) -> list[str]:
    return [f"{next(_NUMBERS):x}" for _ in range(count)]


@pytest.fixture
def store(tmp_path: Path) -> Iterator[StateStore]:
    state_store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    yield state_store
    state_store.close()


def bytes_of_list(revoked: RevokedCertificates, enrolled: set[str], directory: Path) -> int:
    directory.mkdir()
    rows = [(row.serial, row.moment) for row in revoked.rows_to_send(enrolled)]
    signed = x509.load_pem_x509_crl(CertificateAuthority(directory).revocations(rows))
    assert len(signed) == len(rows)
    return len(signed.public_bytes(Encoding.DER))


def test_a_certificate_is_on_the_list_until_it_has_expired(store: StateStore) -> None:
    """It stays a day longer, because clocks differ."""
    revoked = RevokedCertificates(store.hosts)
    now = clock.wall()
    for serial, expires in (("a1", now + DAY), ("a2", now - DAY / 2), ("a3", now - 2 * DAY)):
        revoked.add("a", serial, expires)
    assert {row.serial for row in revoked.rows_to_send({"a"})} == {"a1", "a2"}
    revoked.forget_ended()
    assert {row.serial for row in revoked.rows_to_send({"a"})} == {"a1", "a2"}


@pytest.mark.parametrize("years", [1, 3, 70])
def test_a_clock_that_was_ahead_unrevokes_no_certificate(tmp_path: Path, years: int) -> None:
    now = clock.wall()
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    RevokedCertificates(store.hosts).add("a", "a1", now + DAY)
    ahead = VirtualClock(wall=now + 366 * years * DAY)
    with using(ahead):
        revoked = RevokedCertificates(store.hosts)
        ahead.advance(0.9 * DAY)
        revoked.forget_ended()
        assert revoked.rows_to_send({"a"}) == []
        assert revoked.missing({"a"}) == revoked.wait_for_room({"a"}) == 0
    store.close()
    again = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    assert [row.serial for row in RevokedCertificates(again.hosts).rows_to_send({"a"})] == ["a1"]
    again.close()


def test_revoked_certificates_are_kept_over_restarts(tmp_path: Path) -> None:
    now = clock.wall()
    first = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    revoked = RevokedCertificates(first.hosts)
    revoked.add("a", "a1", now + DAY)
    revoked.add("a", "a2", now - 401 * DAY)
    first.close()
    with contextlib.closing(sqlite3.connect(tmp_path / "state.db")) as database, database:
        for serial, moment in (
            ("b1", now - 10 * DAY),
            ("b2", now - 800 * DAY),
        ):  # as a version before has written
            database.execute("INSERT INTO revoked_certificate VALUES (?, ?)", (serial, moment))
    second = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    running = VirtualClock(wall=now)
    with using(running):
        revoked = RevokedCertificates(second.hosts)
        assert [row.serial for row in revoked.rows_to_send({"a"})] == ["a1", "b1"]
        running.advance(1.1 * DAY)
        revoked.forget_ended()
    second.close()
    third = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    assert {row.serial for row in third.hosts.revoked_certificates()} == {"a1", "b1"}
    third.close()


def test_a_list_of_thousands_is_not_too_long_for_charon(store: StateStore, tmp_path: Path) -> None:
    revoked = RevokedCertificates(store.hosts)
    expires = clock.wall() + 90 * DAY
    for serial in serials(2_000):
        revoked.add("enrolled", serial, expires)
    assert len(revoked.rows_to_send({"enrolled"})) == 2_000
    for serial in serials(2_000):
        revoked.add("gone", serial, expires)
    assert {row.name for row in revoked.rows_to_send({"enrolled"})} == {"enrolled"}
    assert len(revoked.rows_to_send({"enrolled"})) == 2_000
    assert revoked.missing({"enrolled"}) == 0
    assert bytes_of_list(revoked, {"enrolled"}, tmp_path / "ca") <= LONGEST


def test_a_full_list_says_when_it_has_space_again(store: StateStore, tmp_path: Path) -> None:
    revoked = RevokedCertificates(store.hosts)
    expires = clock.wall() + 90 * DAY
    count = 0
    while not (until := revoked.wait_for_room({"a"})):
        for serial in serials(2):
            revoked.add("a", serial, expires + count)
            count += 1
        assert count < 10_000
    assert count > 2_000
    assert until == pytest.approx(expires + DAY)
    assert revoked.missing({"a"}) == 0
    assert revoked.wait_for_room(set()) == 0.0
    for serial in serials(100):
        revoked.add("a", serial, expires)
    assert 0 < revoked.missing({"a"}) <= 100
    assert bytes_of_list(revoked, {"a"}, tmp_path / "ca") <= LONGEST


def test_longer_serial_numbers_fit(store: StateStore, tmp_path: Path) -> None:
    """Older certificates have serial numbers of 160 bits."""
    revoked = RevokedCertificates(store.hosts)
    for number in range(3_000):
        revoked.add("", f"{(1 << 158) + number:x}", clock.wall() + DAY)
    assert bytes_of_list(revoked, set(), tmp_path / "ca") <= LONGEST
    assert revoked.missing(set()) > 1_000
