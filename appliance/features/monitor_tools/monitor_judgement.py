"""Compile the specifications in force from their texts, to describe and draw them."""

from appliance.api.front.problems import Finding, findings_of
from appliance.channel.answers.monitor_answers import Monitors
from appliance.features.monitor_tools.monitor_models import Described, EventShown, PropertyShown
from rosmop.check.sources import compiled_from
from rosmop.logics.picture import dot_of, svg_of
from rosmop.run.engine import MonitorSet
from roswire.definitions import Definitions
from roswire.standard import standard_definitions


class Compiler:
    """Compiles specifications, and keeps the last result for repeated queries."""

    def __init__(self) -> None:
        self._last: tuple[int, MonitorSet] | None = None

    def _set(self, loaded: Monitors) -> MonitorSet:
        if self._last is None or self._last[0] != loaded.revision:
            self._last = (loaded.revision, _compiled(loaded))
        return self._last[1]

    def described(self, loaded: Monitors, name: str) -> Described:
        """Return the description of a monitor. Raises `KeyError`."""
        monitor = self._set(loaded).monitor(name)
        events = [
            EventShown(
                name=event.name,
                line=event.position.line,
                topic=event.topic,
                type=event.service_type or event.type,
                part=event.part,
                every=None if event.period_ns is None else event.period_ns / 1e9,
            )
            for event in monitor.code.events
        ]
        properties = [
            PropertyShown(
                logic=running.code.property.logic,
                formula=running.code.property.formula.strip(),
                categories=list(running.code.property.categories),
                handled=list(running.code.order),
                drawn=dot_of([running.code.property]) is not None,
            )
            for running in monitor.properties
        ]
        return Described(events, properties, sorted(monitor.code.uses), monitor.code.hold)

    def picture(self, loaded: Monitors, name: str) -> str | None:
        """Return a monitor's picture, or None if no automaton is finite. Raises `KeyError`."""
        monitor = self._set(loaded).monitor(name)
        return svg_of([code.property for code in monitor.code.properties])

    def warnings(self, file: str) -> list[Finding]:
        assert self._last is not None  # noqa: S101  callers compile by `described` first
        return findings_of(
            [str(warning) for warning in self._last[1].warnings if warning.position.file == file]
        )


def _compiled(loaded: Monitors) -> MonitorSet:
    known = standard_definitions().extended(Definitions.from_files(loaded.definitions or {}))
    return MonitorSet.of(compiled_from(loaded.files or {}, known, topics=loaded.topics or {}))
