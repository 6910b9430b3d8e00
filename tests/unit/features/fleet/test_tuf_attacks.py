import datetime
import http.server
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rosrv_fleet.bundles.repository import TIMESTAMP_KEY, load_online_key
from securesystemslib.signer import CryptoSigner
from tuf.api.metadata import Metadata, MetaFile, Snapshot, TargetFile, Targets, Timestamp

from appliance.features.fleet import connection
from appliance.features.fleet.connection import CollectorError
from appliance.features.fleet.verified_bundles import (
    BundleRejectedError,
    BundleTooEarlyError,
    VerifiedBundle,
    VerifiedBundles,
)
from appliance.formats.bundle_archive import pack
from appliance.formats.terms import BundlePath, Ring, custom_of
from fleet.tests.support.bundle_site import GROUP, ROBOT, SITE, bundle_files, everywhere, give
from tests.support.waiting import allowed
from tests.unit.features.fleet.robot_site import RobotSite

pytestmark = pytest.mark.nightly

METADATA = "/v1/bundles/metadata"


def in_days(days: float) -> datetime.datetime:
    return (datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)).replace(microsecond=0)


class Field:
    def __init__(self, folder: Path, url: str, site: RobotSite) -> None:
        self.site, self.url, self.folder = site, url, folder
        self.robot = site.robot(url, folder / "robot")

    def poll(self, robot: VerifiedBundles | None = None) -> VerifiedBundle | None:
        asker = robot or self.robot
        asker.refresh()
        selected = asker.fetch_selected()
        return None if selected is None else asker.get(selected)

    def give(self, path: str, body: bytes | None) -> None:
        self.site.lies[path] = lambda handler: give(handler, body)

    def timestamp(self, snapshot: int, version: int | None = None, days: float = 1.0) -> bytes:
        signed = Timestamp(
            version=version or int(time.time()) + 1000,
            expires=in_days(days),
            snapshot_meta=MetaFile(snapshot),
        )
        document = Metadata(signed)
        document.sign(load_online_key(self.site.repository.folder / TIMESTAMP_KEY))
        return document.to_bytes()


@pytest.fixture
def field(tmp_path: Path) -> Iterator[Field]:
    site = RobotSite(tmp_path / "site")
    site.add()
    with site.served() as url:
        made = Field(tmp_path, url, site)
        assert made.poll() is not None
        yield made


def given(field: Field, robot: VerifiedBundles | None = None) -> VerifiedBundle:
    """Return the bundle that the robot takes."""
    taken = field.poll(robot)
    assert taken is not None
    return taken


def refused(field: Field, word: str, robot: VerifiedBundles | None = None) -> None:
    with pytest.raises(BundleRejectedError, match=word):
        field.poll(robot)


def test_an_honest_collector_serves_each_new_bundle(field: Field) -> None:
    files = bundle_files(monitors__a_dot_rv="monitor", policy_dot_ini_dot_tests_dot_yaml="cases: []")
    path = field.site.add(files)
    taken = given(field)
    assert taken.path == path
    assert taken.contents.files == {"a.rv": "monitor"}
    assert taken.contents.cases == "cases: []"


def test_without_a_selection_nothing_is_taken(field: Field) -> None:
    field.site.selection = ""
    assert field.poll() is None


def test_rollback_of_the_timestamp_is_rejected(field: Field) -> None:
    old = field.site.timestamp
    field.site.add()
    assert field.poll() is not None
    field.give(f"{METADATA}/timestamp.json", old)
    refused(field, "version")
    refused(field, "version", field.site.robot(field.url, field.folder / "robot"))


def test_rollback_by_a_stolen_timestamp_key_is_rejected(field: Field) -> None:
    field.site.add()
    assert field.poll() is not None
    field.give(f"{METADATA}/timestamp.json", field.timestamp(snapshot=2))
    refused(field, "version")


def test_a_withdrawn_bundle_is_rejected(field: Field) -> None:
    first = field.site.selection
    field.site.add(keep=1)
    field.site.selection = first
    refused(field, "withdrawn")


def test_the_former_bundle_may_be_selected_while_it_is_signed(field: Field) -> None:
    first = field.site.selection
    field.site.add(keep=2)
    assert field.poll() is not None
    field.site.selection = first
    assert str(given(field).path) == first


def test_freeze_ends_with_the_timestamp(field: Field) -> None:
    field.give(f"{METADATA}/timestamp.json", field.timestamp(snapshot=3, days=-0.01))
    refused(field, "expired")


def test_freeze_by_a_stolen_timestamp_key_ends_with_the_snapshot(tmp_path: Path) -> None:
    months_ago = in_days(-70)
    site = RobotSite(tmp_path / "site", now=lambda: months_ago)
    site.repository.add(SITE, GROUP, bundle_files(), everywhere())
    with site.served() as url:
        field = Field(tmp_path, url, site)
        site.timestamp = field.timestamp(snapshot=3)
        refused(field, "expired")


def test_fast_forward_is_undone_by_new_keys(field: Field) -> None:
    field.give(f"{METADATA}/timestamp.json", field.timestamp(snapshot=3, version=2**31))
    assert field.poll() is not None
    field.site.lies.clear()
    field.site.add()
    refused(field, "version")
    field.site.repository.rotate("timestamp")
    field.site.timestamp = None
    field.site.publish()
    assert given(field).path.version == 2


def test_mix_and_match_is_rejected(field: Field) -> None:
    site = field.site
    old = (site.repository.metadata / f"2.{SITE}.{GROUP}.json").read_bytes()
    site.add()
    field.give(f"{METADATA}/3.{SITE}.{GROUP}.json", old)
    refused(field, "v3, got v2")


def test_endless_data_is_cut(field: Field) -> None:
    def endless(handler: http.server.BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.end_headers()
        handler.close_connection = True
        for _ in range(2000):
            handler.wfile.write(bytes(1 << 16))

    field.site.lies[f"{METADATA}/timestamp.json"] = endless
    with pytest.raises(CollectorError, match="more than"):
        field.poll()
    field.site.lies.clear()
    path = field.site.add(bundle_files(monitors__long_dot_rv="x" * 10_000))
    (target,) = [one for at, one in field.site.repository.bundles() if at == path]
    field.site.lies[f"/v1/bundles/targets/{target.get_prefixed_paths()[0]}"] = endless
    refused(field, "exceeding")


def test_slow_retrieval_is_cut(field: Field, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "_EXCHANGE_SECONDS", 0.3)

    def slow(handler: http.server.BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Length", "500")
        handler.end_headers()
        for _ in range(100):
            handler.wfile.write(b"x")
            threading.Event().wait(0.05)  # the pause of a slow collector

    field.site.lies[f"{METADATA}/timestamp.json"] = slow
    began = time.monotonic()
    with pytest.raises(CollectorError, match="takes more than"):
        field.poll()
    assert time.monotonic() - began < allowed(4)


def test_the_wrong_target_is_rejected(field: Field) -> None:
    path = field.site.add(bundle_files("[Nodes]\n"))
    found = {at.version: target for at, target in field.site.repository.bundles()}
    old = (field.site.repository.targets / found[1].get_prefixed_paths()[0]).read_bytes()
    field.give(f"/v1/bundles/targets/{found[path.version].get_prefixed_paths()[0]}", old)
    refused(field, "length|hash")


def test_arbitrary_software_is_rejected(field: Field) -> None:
    forged = Metadata(Timestamp(int(time.time()) + 9, expires=in_days(1), snapshot_meta=MetaFile(9)))
    field.give(f"{METADATA}/timestamp.json", forged.to_bytes())
    refused(field, "signed")
    forged.sign(CryptoSigner.generate_ed25519())
    field.give(f"{METADATA}/timestamp.json", forged.to_bytes())
    refused(field, "signed")
    foreign = RobotSite(field.folder / "foreign")
    foreign.add()
    field.give(f"{METADATA}/timestamp.json", foreign.timestamp)
    refused(field, "signed")


def test_a_group_key_signs_for_no_other_group(field: Field) -> None:
    repository = field.site.repository
    repository.delegate(SITE, "lifts")
    archive = pack(bundle_files())
    listed = Metadata[Targets].from_file(str(repository.metadata / f"1.{SITE}.lifts.json"))
    path = BundlePath(SITE, GROUP, 99)
    target = TargetFile.from_data(str(path), archive, ["sha256"])
    target.unrecognized_fields["custom"] = custom_of(everywhere())
    listed.signed.targets[str(path)] = target
    listed.signed.version = 2
    for signer in repository.keys.signers(f"{SITE}.lifts", repository.keyids_of(f"{SITE}.lifts")):
        listed.sign(signer)
    listed.to_file(str(repository.metadata / f"2.{SITE}.lifts.json"))
    (repository.targets / SITE / GROUP).mkdir(parents=True, exist_ok=True)
    for name in target.get_prefixed_paths():
        (repository.targets / name).write_bytes(archive)
    repository.snapshot()
    field.site.publish()
    field.site.selection = str(path)
    refused(field, "not signed")


def test_bundles_of_other_robots_are_rejected(field: Field) -> None:
    repository = field.site.repository
    for site, group in ((SITE, "lifts"), ("site-b", GROUP)):
        repository.delegate(site, group)
        path = repository.add(site, group, bundle_files(), everywhere())
        field.site.publish()
        field.site.selection = str(path)
        refused(field, "other robots")
    assert not [path for path in field.site.requests if "lifts" in path or "site-b" in path]


@pytest.mark.parametrize(
    "selection", ["../../etc/passwd", "x", "a/b/0.tar", "site-a/arms/1.tar\nsite-a", "\x00" * 900]
)
def test_an_invalid_selection_is_rejected(field: Field, selection: str) -> None:
    field.site.selection = selection
    refused(field, "invalid")


def test_a_later_ring_does_not_take_a_bundle_early(field: Field) -> None:
    rings = (Ring("canary", ["canary-1"]), Ring("rest", [], 100, 3600))
    path = field.site.add(terms=everywhere(None, *rings))
    with pytest.raises(BundleTooEarlyError):
        field.poll()
    canary = field.site.robot(field.url, field.folder / "canary", "canary-1")
    assert given(field, canary).path == path
    later = field.site.robot(field.url, field.folder / "later", ROBOT, lambda: time.time() + 3601)
    assert field.poll(later) is not None


def test_a_compromised_root_key_is_replaced(field: Field) -> None:
    site, repository = field.site, field.site.repository
    old = {
        role: repository.keys.signers(role, repository.keyids_of(role)) for role in ("snapshot", "targets")
    }
    for role in ("root", "targets", "snapshot", f"{SITE}.{GROUP}"):
        repository.rotate(role)
    path = site.add()
    assert given(field).path == path
    stolen = Metadata(Snapshot(version=50, meta={"targets.json": MetaFile(50)}))
    stolen.signed.expires = in_days(1)
    stolen.sign(old["snapshot"][0])
    field.give(f"{METADATA}/50.snapshot.json", stolen.to_bytes())
    field.give(f"{METADATA}/timestamp.json", field.timestamp(snapshot=50))
    refused(field, "signed")


def test_a_root_that_the_old_root_did_not_sign_is_rejected(field: Field) -> None:
    foreign = RobotSite(field.folder / "foreign")
    foreign.repository.rotate("root")
    field.give(f"{METADATA}/2.root.json", (foreign.repository.metadata / "2.root.json").read_bytes())
    refused(field, "signed")


def test_lost_knowledge_begins_with_the_given_root(field: Field) -> None:
    for _ in range(3):
        field.site.repository.rotate("root")
    field.site.add()
    shutil.rmtree(field.folder / "robot")
    assert field.poll() is not None


def test_redirects_and_compression_are_not_followed(field: Field) -> None:
    def elsewhere(handler: http.server.BaseHTTPRequestHandler) -> None:
        handler.send_response(302)
        handler.send_header("Location", "https://127.0.0.1:1/")
        handler.send_header("Content-Length", "0")
        handler.end_headers()

    def bomb(handler: http.server.BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Encoding", "gzip")
        handler.send_header("Content-Length", "3")
        handler.end_headers()
        handler.wfile.write(b"\x1f\x8b\x08")

    for lie, word in ((elsewhere, "302"), (bomb, "is compressed")):
        field.site.lies[f"{METADATA}/timestamp.json"] = lie
        with pytest.raises(CollectorError, match=word):
            field.poll()
