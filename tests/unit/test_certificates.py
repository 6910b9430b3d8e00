"""Certificates that are made before the machine's clock is set, as on a computer without a clock of its own."""

import datetime
import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest
from cryptography import x509

from appliance.api.front.certificate import CERTIFICATE, renew, tls_context
from appliance.base import clock, shipped
from appliance.ipsec.certificate_authority import CertificateAuthority
from appliance.ipsec.requests import make_key, signing_request
from appliance.signing.own_certificate import make_own_certificate
from tests.support.rows import require_rows
from tests.support.sources import ROOT
from tests.support.virtual_clock import VirtualClock

_MAKES = re.compile(r"(?:Certificate|CertificateRevocationList)Builder\(")
BUILT = Path(shipped.__file__).stat().st_mtime
IMAGE = BUILT - 200 * 86_400.0


def _of_the_authority(folder: Path) -> list[bytes]:
    authority = CertificateAuthority(folder)
    names = ("a", "rosrv-appliance")
    made = [authority.issue(signing_request(make_key(), name), name, 90).certificate for name in names]
    return [authority.certificate, *made]


def _of_rest(folder: Path) -> list[bytes]:
    tls_context(folder, [], clock.utc_now())
    return [(folder / CERTIFICATE).read_bytes()]


MADE: dict[str, Callable[[Path], list[bytes]]] = {
    "appliance/ipsec/certificate_authority.py": _of_the_authority,
    "appliance/api/front/certificate.py": _of_rest,
    "appliance/signing/own_certificate.py": lambda _folder: [make_own_certificate("robot", 90)[1]],
}
for path in sorted((ROOT / "tests/unit/features").glob("*/certificates.py")):
    MADE |= import_module(".".join(path.relative_to(ROOT).with_suffix("").parts)).MADE


def test_every_maker_of_certificates_has_its_row() -> None:
    makers = {
        str(path.relative_to(ROOT))
        for folder in ("appliance", "fleet/src/rosrv_fleet")
        for path in (ROOT / folder).rglob("*.py")
        if _MAKES.search(path.read_text(encoding="utf-8"))
    }
    require_rows(makers, MADE, "MADE here; of a feature, to MADE in the certificates.py of its tests")


@pytest.mark.parametrize("wall", [10.0, IMAGE], ids=["1970", "the date of an image"])
@pytest.mark.parametrize("maker", MADE)
def test_a_certificate_of_the_time_before_is_valid_when_the_clock_is_set(
    maker: str, wall: float, tmp_path: Path
) -> None:
    with clock.using(machine := VirtualClock(wall=wall)):
        made = [x509.load_pem_x509_certificate(one) for one in MADE[maker](tmp_path)]
        for at in (wall, BUILT + 60 * 86_400.0):
            machine.set_wall(at)
            now = datetime.datetime.fromtimestamp(at, datetime.UTC)
            assert all(one.not_valid_before_utc <= now < one.not_valid_after_utc for one in made)


@pytest.mark.parametrize("days", [40, 4000])
@pytest.mark.parametrize("maker", MADE)
def test_a_certificate_of_a_clock_that_was_ahead_is_valid_when_it_is_set(
    maker: str, days: float, tmp_path: Path
) -> None:
    """REST makes another one within a minute. `rosrv status` names a host whose certificate is not valid yet, and the
    collector refuses to let such a robot join.
    """
    with clock.using(machine := VirtualClock(wall=BUILT + days * 86_400.0)):
        made = MADE[maker](tmp_path)
        machine.set_wall(BUILT + 86_400.0)
        now = clock.utc_now()
        if maker == "appliance/api/front/certificate.py":
            assert (
                renew(tls_context(tmp_path, [], now), tmp_path, [], now) is False
            )  # the context made it again
            made = [(tmp_path / CERTIFICATE).read_bytes()]
        read = [x509.load_pem_x509_certificate(one) for one in made]
        late = [one for one in read if not one.not_valid_before_utc <= now < one.not_valid_after_utc]
        assert [one.subject.rfc4514_string() for one in late] == {
            "appliance/ipsec/certificate_authority.py": ["CN=a,O=ROSRV"],
            "appliance/signing/own_certificate.py": ["CN=robot"],
        }.get(maker, [])


def test_the_certificate_of_rest_stays_when_the_clock_is_set(tmp_path: Path) -> None:
    with clock.using(machine := VirtualClock(wall=10.0)):
        context = tls_context(tmp_path, [], clock.utc_now())
        machine.set_wall(BUILT + 60 * 86_400.0)
        assert not renew(context, tmp_path, [], clock.utc_now())
