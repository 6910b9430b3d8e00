import datetime
import ssl
from pathlib import Path

import pytest

from tests.support.certificates import self_signed
from tests.support.command import rosrv
from tests.support.fake_appliance import TOKEN, FakeAppliance

pytestmark = pytest.mark.nightly


def certificate(path: Path, address: str = "127.0.0.1", days: int = 2) -> ssl.SSLContext:
    now = datetime.datetime.now(datetime.UTC)
    key = self_signed(path, address, now - datetime.timedelta(days=10), now + datetime.timedelta(days=days))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(path, key)
    return context


CERTIFICATES = {"right": {}, "other": {}, "elsewhere": {"address": "10.9.9.9"}, "old": {"days": -2}}


@pytest.mark.parametrize(
    ("served", "trusted", "said"),
    [
        ("right", None, "is not trusted: print it there (rosrv certificate)"),
        ("right", "other", "is not trusted"),
        ("elsewhere", "elsewhere", "is not for this name or address"),
        ("old", "old", "has expired"),
        ("right", "text", "has no certificate in PEM"),
        ("right", "nowhere", "No such file"),
    ],
)
def test_an_untrusted_certificate_gets_nothing(
    tmp_path: Path, served: str, trusted: str | None, said: str
) -> None:
    contexts = {name: certificate(tmp_path / name, **given) for name, given in CERTIFICATES.items()}  # type: ignore[arg-type]  # a table
    (tmp_path / "text").write_text("nothing")
    with FakeAppliance(contexts[served]) as fake:
        given = [] if trusted is None else ["--api-ca", str(tmp_path / trusted)]
        done = rosrv("status", "--api", fake.url, *given, ROSRV_TOKEN=TOKEN)
        assert (done.returncode, fake.requests) == (2, [])
        assert said in done.stderr


def test_a_trusted_certificate_gets_the_request(tmp_path: Path) -> None:
    right = str(tmp_path / "right.pem")
    with FakeAppliance(certificate(Path(right))) as fake:
        fake.problem(403, "refused", "reached")
        assert "reached" in rosrv("status", "--api", fake.url, "--api-ca", right, ROSRV_TOKEN=TOKEN).stderr
        by_environment = {"ROSRV_API_CA": right, "ROSRV_TOKEN": TOKEN}
        assert "reached" in rosrv("status", "--api", fake.url, **by_environment).stderr
    with FakeAppliance() as fake:
        url = fake.url.replace("http:", "https:")
        assert "is it http" in rosrv("status", "--api", url, ROSRV_TOKEN=TOKEN).stderr


def test_deeply_nested_json_is_an_error_of_the_server() -> None:
    with FakeAppliance() as fake:
        fake.body = b"[" * 100_000
        done = rosrv("status", "--api", fake.url, ROSRV_TOKEN=TOKEN)
    assert done.returncode == 2
    assert "is not an appliance's REST API" in done.stderr
