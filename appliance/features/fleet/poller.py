"""Poll the collector: verify its metadata, offer the selected bundle to control, and report the robot's state.

Only bundles that `VerifiedBundles` has accepted are offered. A refused bundle is not offered again until the
collector selects another one.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
import structlog

from appliance.base import clock
from appliance.features.fleet.bundle_link import BundleOffered, BundlePollReported, BundleStated
from appliance.features.fleet.connection import CollectorConnection, CollectorError
from appliance.features.fleet.verified_bundles import (
    BundleFolderError,
    BundleRejectedError,
    BundleTooEarlyError,
    SelectedBundle,
    VerifiedBundle,
    VerifiedBundles,
)
from appliance.formats.bundle_api import REPORT, RobotReport

_log = structlog.get_logger()
_BACK_OFF = (1.0, 2.0, 5.0, 15.0, 30.0, 60.0)
_JITTER = 0.2  # of the pause, in both directions
_REPORT_SECONDS = 30.0
_REPORT_AGAIN_SECONDS = 5.0


@dataclass(slots=True)
class Poller:
    """Polls the collector. `stated()` returns control's last statement; `offer` sends a bundle to control."""

    bundles: VerifiedBundles
    connection: CollectorConnection
    place: tuple[str, str]  # site and group
    interval: float
    stated: Callable[[], BundleStated | None]
    offer: Callable[[BundleOffered], object]
    clock: Callable[[], float] = clock.wall
    progress: BundlePollReported = field(default_factory=BundlePollReported)
    _failures: int = 0
    _reported: RobotReport | None = None
    report_due: float = 0.0
    _early: str = ""
    _retry_at: float = 0.0

    def step(self) -> float:
        stated = self.stated()
        if stated is None:
            return _jittered(_BACK_OFF[0])
        pause = self._checked(stated)
        self._report(self.stated() or stated)
        return pause

    def report(self) -> None:
        stated = self.stated()
        if stated is not None:
            self._report(stated)

    def _checked(self, stated: BundleStated) -> float:
        self._early, offers = "", False
        try:
            self.bundles.refresh()
            selected = self.bundles.selected()
            if selected is not None and _is_news(selected, stated):
                self.offer(_offered(self.bundles.get(selected)))
                offers = True
        except BundleTooEarlyError as error:
            self._early = str(error)
            pause = max(1.0, error.at - self.clock())
        except (BundleRejectedError, BundleFolderError, CollectorError) as error:
            return self._failed(error)
        else:
            pause = self.interval
        if self._failures:
            _log.warning("the collector's bundles are verified again")
        self._failures = 0
        self.progress = BundlePollReported(self.clock(), offered=offers)
        return _jittered(min(self.interval, pause))

    def _failed(self, error: Exception) -> float:
        if not self._failures:
            _log.error("the collector's bundles cannot be verified; trying again", reason=str(error))
        pause = _BACK_OFF[min(self._failures, len(_BACK_OFF) - 1)]
        self._failures += 1
        self.progress = BundlePollReported(
            self.progress.checked, str(error)[:1000], isinstance(error, BundleRejectedError)
        )
        return _jittered(min(pause, self.interval))

    def _report(self, stated: BundleStated) -> None:
        refused = stated.refused
        report = RobotReport(
            *self.place,
            stated.in_force,
            stated.trying,
            "" if refused is None else refused.path,
            "" if refused is None else refused.reason[:1000],
            stated.changed,
            stated.health.denials,
            stated.health.failing,
            self.progress.trouble or stated.waits or self._early,
        )
        now = clock.now()
        pressing = self._reported is None or _fate_of(report) != _fate_of(self._reported)
        if now < (self._retry_at if pressing else self.report_due):
            return
        try:
            body = msgspec.json.encode(report)
            self.connection.put(REPORT, iter([body]), len(body), [("Content-Type", "application/json")])
        except CollectorError as error:
            self._retry_at = self.report_due = now + _jittered(_REPORT_AGAIN_SECONDS)
            if not self.progress.trouble:
                self.progress = BundlePollReported(self.progress.checked, str(error)[:1000])
            return
        self._reported, self.report_due = report, now + _jittered(_REPORT_SECONDS)


def _fate_of(report: RobotReport) -> RobotReport:
    return msgspec.structs.replace(report, denials=0, failing=0)


def _is_news(selected: SelectedBundle, stated: BundleStated) -> bool:
    """Return whether control has not yet decided about these bytes: a path can be signed again with others."""
    bundle, refused = (str(selected.path), selected.sha256), stated.refused
    if bundle[0] == stated.trying:  # other bytes of the same path wait for the end of the trial
        return False
    return bundle not in ((stated.in_force, stated.sha256), refused and (refused.path, refused.sha256))


def _offered(bundle: VerifiedBundle) -> BundleOffered:
    return BundleOffered(str(bundle.path), bundle.sha256, bundle.contents)


def _jittered(seconds: float) -> float:
    """Vary a pause, so that robots do not ask at the same time."""
    return seconds * random.uniform(1 - _JITTER, 1 + _JITTER)  # noqa: S311  spreads load, protects nothing
