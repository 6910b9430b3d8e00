from collections.abc import Iterator

import msgspec
import pytest
from tuf.api.metadata import TargetFile

from appliance.features.fleet.bundle_link import BundleOffered, BundleStated, RefusedBundle
from appliance.features.fleet.connection import CollectorConnection, CollectorError
from appliance.features.fleet.process import Poller
from appliance.features.fleet.verified_bundles import (
    BundleRejectedError,
    BundleTooEarlyError,
    SelectedBundle,
    VerifiedBundle,
    VerifiedBundles,
)
from appliance.formats.bundle_api import RobotReport
from appliance.formats.bundle_archive import BundleContents
from appliance.formats.terms import BundlePath
from tests.support.idle import idle, replace

PATH = BundlePath("site-a", "arms", 7)
TIME = 1_700_000_000.0


class Site:
    """A poller between a collector that selects bytes of `PATH`, and control."""

    def __init__(self) -> None:
        self.selected = "new"
        self.errors: Iterator[Exception | None] = iter(())
        self.stated = BundleStated()
        self.offered: list[tuple[str, str]] = []
        self.reported: list[RobotReport] = []
        bundles, connection = idle(VerifiedBundles), idle(CollectorConnection)
        replace(bundles, fetch_selected=self._select, get=self._get)
        replace(connection, put=self._put)
        self.poller = Poller(
            bundles, connection, (PATH.site, PATH.group), 60.0, lambda: self.stated, self._offer, lambda: TIME
        )

    def _select(self) -> SelectedBundle:
        return SelectedBundle(PATH, TargetFile(1, {"sha256": self.selected}, str(PATH)))

    def _get(self, selected: SelectedBundle) -> VerifiedBundle:
        error = next(self.errors, None)
        if error is not None:
            raise error
        return VerifiedBundle(selected.path, selected.sha256, BundleContents("[Nodes]\n", "hosts: []\n"))

    def _put(self, _path: str, body: Iterator[bytes], *_given: object) -> None:
        self.reported.append(msgspec.json.decode(b"".join(body), type=RobotReport))

    def _offer(self, bundle: BundleOffered) -> None:
        self.offered.append((bundle.path, bundle.sha256))


@pytest.mark.parametrize(
    ("stated", "offered"),
    [
        (BundleStated(), True),
        (BundleStated(str(PATH), "new"), False),
        (BundleStated(str(PATH), "old"), True),
        (BundleStated(str(PATH._replace(version=6)), "new"), True),
        (BundleStated(refused=RefusedBundle(str(PATH), "new", "no")), False),
        (BundleStated(refused=RefusedBundle(str(PATH), "old", "no")), True),
        (BundleStated(str(PATH), "old", str(PATH)), False),
    ],
    ids=["none", "in force", "other bytes in force", "other path", "refused", "other bytes refused", "trial"],
)
def test_a_bundle_is_offered_until_control_has_decided_about_its_bytes(
    stated: BundleStated, offered: bool
) -> None:
    site = Site()
    site.stated = stated
    site.poller.step()
    assert site.offered == [(str(PATH), "new")] * offered


def test_a_bundle_that_is_too_early_ends_the_failures() -> None:
    """The collector's files were verified, so the status shows no trouble, and the next check comes in time."""
    site = Site()
    site.errors = iter(
        [CollectorError("no answer"), BundleRejectedError("expired"), BundleTooEarlyError(PATH, TIME + 20)]
    )
    troubles, pauses = [], []
    for _ in range(4):
        pauses.append(site.poller.step())
        progress = site.poller.progress
        troubles.append((progress.checked, progress.trouble, progress.rejected))
    assert troubles == [(0.0, "no answer", False), (0.0, "expired", True), *[(TIME, "", False)] * 2]
    for pause, expected in zip(pauses, (1.0, 2.0, 20.0, 60.0), strict=True):
        assert pause == pytest.approx(expected, rel=0.2)
    assert site.offered == [(str(PATH), "new")]
    site.stated, site.errors = BundleStated(), iter([CollectorError("no answer")])
    assert site.poller.step() == pytest.approx(1.0, rel=0.2)  # the first failure again


@pytest.mark.parametrize(
    ("stated", "error", "reason"),
    [
        (BundleStated(waits="a local change waits"), None, "a local change waits"),
        (BundleStated(), BundleTooEarlyError(PATH, TIME + 20), f"{PATH} is for this robot's ring in "),
        (BundleStated(), CollectorError("no answer"), "no answer"),
        (BundleStated(), None, ""),
    ],
    ids=["waits", "too early", "fails", "none"],
)
def test_the_collector_hears_why_the_robot_is_behind(
    stated: BundleStated, error: Exception | None, reason: str
) -> None:
    site = Site()
    site.stated, site.errors = stated, iter([error])
    site.poller.step()
    assert site.reported[-1].trouble.startswith(reason)
    assert bool(site.reported[-1].trouble) == bool(reason)


def test_control_hears_whether_a_check_offered_a_bundle() -> None:
    site = Site()
    site.poller.step()
    assert site.poller.progress.offered
    site.stated = BundleStated(str(PATH), "new")
    site.poller.step()
    assert not site.poller.progress.offered
