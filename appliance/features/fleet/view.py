"""Show the push and the bundles in the status, the alarms and the metrics."""

from collections.abc import Iterator
from typing import Annotated

import msgspec

from appliance.base import clock
from appliance.base.metric import counter, gauge
from appliance.base.timestamps import age
from appliance.channel.answers.field_docs import Moment, doc
from appliance.features.view import AlarmKind, FeatureView, Pieces, Samples, StateView, Trouble
from appliance.forwarding.forwarding_state import ForwardingState, samples_of


class BundlesState(msgspec.Struct, frozen=True):
    """The bundle of the fleet in force (SITE/GROUP/VERSION.tar, or empty), and the results of later ones."""

    collector: Annotated[str, doc("URL of the collector")]
    in_force: Annotated[str, doc("the bundle in force, or empty if there is none")]
    sha256: Annotated[str, doc("SHA-256 of its archive")]
    since: Annotated[Moment | None, doc("when its trial ended, or null if none is in force")]
    trying: Annotated[str, doc("the bundle in its commit-confirm period, or empty if there is none")]
    refused: Annotated[
        str, doc("the last bundle that this robot refused, or empty if none since the bundle in force")
    ]
    reason: Annotated[str, doc("why it was refused")]
    changed: Annotated[bool, doc("an operator has changed a part of the bundle on this robot")]
    checked: Annotated[
        Moment | None, doc("when the collector's metadata were last verified, or null if not yet")
    ]
    trouble: Annotated[str, doc("why no bundles are taken now, or empty if they are")]
    rejected: Annotated[bool, doc("the collector serves metadata that are not accepted")]
    for_order: Annotated[str, doc("the bundle that waits for `rosrv fleet take`, or empty if none does")] = ""


_COLLECTOR_METRICS = (
    gauge("rosrv_collector_up", "1 while segments are pushed to the collector; absent if none is configured"),
    counter("rosrv_collector_sent_total", "segments with a receipt since the pusher started"),
    gauge("rosrv_collector_lag_records", "sealed audit records that the collector does not have"),
    gauge("rosrv_collector_lag_seconds", "how long the oldest such record has waited"),
    counter("rosrv_collector_missed_total", "records that retention removed before the collector had them"),
)
_BUNDLE_METRICS = (
    gauge(
        "rosrv_bundle_version",
        "version of the bundle in force; 0 without one. Only robots with bundles have this metric",
    ),
    gauge("rosrv_bundle_refused", "1 if a bundle was refused since the one in force"),
    gauge("rosrv_bundle_changed", "1 while a part of the bundle in force is changed on this robot"),
    gauge(
        "rosrv_bundle_checked_seconds", "since the collector's metadata were last verified, or -1 if not yet"
    ),
    gauge("rosrv_bundle_rejected", "1 while the collector serves bundles or metadata that are not accepted"),
)


def _collector_alarms(state: ForwardingState) -> Iterator[Trouble]:
    if state.trouble:
        where = f"the audit log is not collected by {state.to}, {state.behind} sealed records wait"
        yield Trouble("audit-not-collected", f"{where}: {state.trouble}", "audit")


def _bundle_alarms(bundles: BundlesState) -> Iterator[Trouble]:
    if bundles.refused:
        stays = f"{bundles.in_force} stays" if bundles.in_force else "no bundle is"
        text = f"{bundles.refused} is refused, {stays} in force: {bundles.reason.splitlines()[0]}"
        yield Trouble("bundle-refused", text)
    if bundles.rejected:
        text = f"the collector {bundles.collector} serves bundles that are not accepted: {bundles.trouble}"
        yield Trouble("bundles-rejected", text)
    elif bundles.trouble:
        yield Trouble("bundles-not-polled", f"no new bundles: {bundles.trouble}")
    if bundles.changed:
        text = f"{bundles.in_force} is in force, but was changed on this robot since"
        yield Trouble("bundle-changed", text)


def _bundle_samples(bundles: BundlesState) -> dict[str, Samples]:
    number = bundles.in_force.rpartition("/")[2].removesuffix(".tar")
    checked = -1.0 if bundles.checked is None else clock.wall() - bundles.checked
    return {
        "rosrv_bundle_version": [((), int(number or 0))],
        "rosrv_bundle_refused": [((), bool(bundles.refused))],
        "rosrv_bundle_changed": [((), bundles.changed)],
        "rosrv_bundle_checked_seconds": [((), checked)],
        "rosrv_bundle_rejected": [((), bundles.rejected)],
    }


def _bundle_line(bundles: BundlesState) -> tuple[str, Pieces]:
    line = [(f"{bundles.in_force or 'none'}{' in force' if bundles.in_force else ''}", "")]
    if bundles.changed:
        line.append(("; changed on this robot since", "yellow"))
    if bundles.trying:
        line.append((f"; {bundles.trying} waits for its confirmation", ""))
    if bundles.refused:
        line.append((f"; {bundles.refused} REFUSED", "yellow"))
    checked = "not verified yet" if bundles.checked is None else f"verified {age(bundles.checked)} ago"
    line.append((f"; the collector's metadata {'were ' if bundles.checked else ''}{checked}", ""))
    return "bundle", line


FLEET_VIEW = FeatureView(
    (
        StateView(
            "collector",
            ForwardingState,
            "segments pushed to the collector, or null if none is configured",
            part="audit",
            kinds={
                "audit-not-collected": AlarmKind("warning", "repair the collector; records wait on the disk")
            },
            alarms=_collector_alarms,
            metrics=_COLLECTOR_METRICS,
            samples=lambda state: samples_of("collector", state),
            line=lambda state: ("", f"{state.behind} to be collected by {state.to}"),
        ),
        StateView(
            "bundles",
            BundlesState,
            "the bundles of the fleet, or null if none are configured",
            before="handled_alarms",
            kinds={
                "bundle-refused": AlarmKind("warning", "correct the bundle; the last one stays in force"),
                "bundles-rejected": AlarmKind("alarm", "find out who serves them: they are not of the fleet"),
                "bundles-not-polled": AlarmKind("warning", "repair the collector"),
                "bundle-changed": AlarmKind("notice", "an operator changed it here on purpose"),
            },
            alarms=_bundle_alarms,
            metrics=_BUNDLE_METRICS,
            samples=_bundle_samples,
            line=_bundle_line,
        ),
    ),
)
