import datetime
from pathlib import Path

from rosrv_fleet.bundles.publication import next_timestamp, read_publication
from rosrv_fleet.bundles.repository import TIMESTAMP_KEY, load_online_key
from tuf.api.metadata import Metadata, Timestamp

from fleet.tests.support.bundle_site import BundleSite


def test_a_timestamp_of_a_clock_that_was_ahead_is_replaced(tmp_path: Path) -> None:
    """Robots notice a freeze within 24 hours, not when the metadata expire."""
    site = BundleSite(tmp_path)
    publication = read_publication(site.repository.folder)
    key = load_online_key(site.repository.folder / TIMESTAMP_KEY)
    ahead = next_timestamp(publication, None, key, publication.expires + datetime.timedelta(days=1))
    now = publication.expires - datetime.timedelta(days=30)
    made = next_timestamp(publication, ahead, key, now)
    assert ahead is not None
    assert made is not None
    before, after = (Metadata[Timestamp].from_bytes(one).signed for one in (ahead, made))
    assert before.version < after.version
    assert after.expires == (now + datetime.timedelta(hours=24)).replace(microsecond=0)


def test_a_timestamp_is_signed_only_when_it_lasts_longer(tmp_path: Path) -> None:
    site = BundleSite(tmp_path)
    publication = read_publication(site.repository.folder)
    key = load_online_key(site.repository.folder / TIMESTAMP_KEY)
    second = datetime.timedelta(seconds=1)
    for now in (publication.expires - datetime.timedelta(hours=2), publication.expires + second):
        made = next_timestamp(publication, None, key, now)
        assert made is not None
        assert next_timestamp(publication, made, key, now + second) is None
    early = publication.expires - datetime.timedelta(days=9)
    made = next_timestamp(publication, None, key, early)
    assert next_timestamp(publication, made, key, early + datetime.timedelta(hours=7)) is None
    assert next_timestamp(publication, made, key, early + datetime.timedelta(hours=9)) is not None
