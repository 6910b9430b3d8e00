import io
import tarfile

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.formats.bundle_archive import LONGEST, BundleArchiveError, contents_of, pack, unpack
from appliance.formats.terms import BundlePath, Ring, Terms, TermsError, checked_terms, custom_of, terms_of

FILES = {"policy.ini": b"[Nodes]\n", "hosts.yaml": b"hosts: []\n"}
texts = st.text(st.characters(codec="utf-8", exclude_characters="\r\ufeff"), max_size=600).map(str.encode)
names = st.sampled_from(
    ["monitors/a.rv", "monitors/a.rv.sig", "monitors/msg/pkg/A.msg", "policy.ini.tests.yaml"]
)


def tar(*members: tuple[tarfile.TarInfo, bytes], form: int = tarfile.USTAR_FORMAT) -> bytes:
    output = io.BytesIO()
    with tarfile.open(fileobj=output, mode="w", format=form) as file:
        for name, data in sorted(FILES.items()):
            one = tarfile.TarInfo(name)
            one.size = len(data)
            file.addfile(one, io.BytesIO(data))
        for member, data in members:
            file.addfile(member, io.BytesIO(data))
    return output.getvalue()


def member(name: str, kind: bytes = tarfile.REGTYPE, **fields: object) -> tarfile.TarInfo:
    made = tarfile.TarInfo(name)
    made.type = kind
    for field, value in fields.items():
        setattr(made, field, value)
    return made


@given(st.dictionaries(names, texts, max_size=4))
def test_contents_survive_an_archive(more: dict[str, bytes]) -> None:
    files = FILES | more
    if "monitors/a.rv.sig" in files and "monitors/a.rv" not in files:
        del files["monitors/a.rv.sig"]
    archive = pack(files)
    assert unpack(archive) == contents_of(files)
    assert pack(dict(reversed(files.items()))) == archive


@pytest.mark.parametrize(
    "archive",
    [
        tar((member("monitors/x.rv", tarfile.SYMTYPE, linkname="/etc/passwd"), b"")),
        tar((member("monitors/x.rv", tarfile.LNKTYPE, linkname="policy.ini"), b"")),
        tar((member("monitors/x.rv", tarfile.CHRTYPE), b"")),
        tar((member("monitors", tarfile.DIRTYPE), b"")),
        tar((member("../x.rv"), b"")),
        tar((member("/etc/x"), b"")),
        tar((member("monitors/../../x.rv"), b"")),
        tar((member("policy.ini"), b"")),
        tar((member("monitors/x.rv", mode=0o4755), b"")),
        tar((member("monitors/x.rv", uid=7), b"")),
        tar(form=tarfile.PAX_FORMAT) + b"\0" * 512,
        tar() + b"more",
        tar()[:700],
        b"",
        b"\x1f\x8b" + b"\0" * 600,
        b"\0" * 10_240,
        pack(FILES) + b"\0" * 512,
    ],
)  # fmt: skip
def test_other_archives_are_rejected(archive: bytes) -> None:
    with pytest.raises(BundleArchiveError):
        unpack(archive)


@given(st.binary(max_size=3000))
def test_any_bytes_are_an_archive_or_rejected(noise: bytes) -> None:
    whole = pack(FILES)
    for data in (noise, whole[: len(noise)] + noise, noise[:512] + whole[512:], whole[:512] + noise):
        try:
            unpack(data)
        except BundleArchiveError:
            continue
        assert data == whole


@pytest.mark.parametrize(
    ("files", "word"),
    [
        ({"policy.ini": b""}, "hosts.yaml is missing"),
        (FILES | {"README": b""}, "README"),
        (FILES | {"policy.ini": b"\xff"}, "not UTF-8"),
        (FILES | {"monitors/x.rv.sig": b""}, "signature of a file"),
        (FILES | {"monitors/x.rv": bytes(LONGEST)}, "limit"),
    ],
)
def test_wrong_contents_are_rejected(files: dict[str, bytes], word: str) -> None:
    with pytest.raises(BundleArchiveError, match=word):
        pack(files)


@given(st.text(min_size=1, max_size=20), st.integers(1, 10**6))
def test_each_robot_is_in_one_ring(robot: str, version: int) -> None:
    terms = Terms(1000, [Ring("canary", ["arm-1"]), Ring("some", [], 30, 60), Ring("rest", [], 100, 600)])
    path = BundlePath("site-a", "arms", version)
    assert terms.ring_of(robot, path) in (0, 1, 2)
    assert terms.ring_of("arm-1", path) == 0
    assert terms.earliest("arm-1", path) == 1000
    assert terms_of(custom_of(terms)) == terms


@pytest.mark.parametrize(
    "rings",
    [
        [],
        [Ring("a", [], 50)],
        [Ring("a", [], 100), Ring("a", [], 100)],
        [Ring("a", [], 60), Ring("b", [], 50), Ring("c", [], 100)],
        [Ring("a", ["x"], 0, 10), Ring("b", [], 100, 5)],
        [Ring("a"), Ring("b", [], 100)],
        [Ring("A", [], 100)],
        [Ring("a", ["../x"], 0), Ring("b", [], 100)],
        [Ring("a", [], 100, -1)],
    ],
)
def test_wrong_rings_are_rejected(rings: list[Ring]) -> None:
    with pytest.raises(TermsError):
        checked_terms(Terms(1, rings))


@pytest.mark.parametrize("custom", [None, {}, {"rosrv": 1}, {"rosrv": {"signed": "x", "rings": []}}, [], "x"])
def test_a_target_without_terms_is_rejected(custom: object) -> None:
    with pytest.raises(TermsError):
        terms_of(custom)
