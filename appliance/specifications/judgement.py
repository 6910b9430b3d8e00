"""Check the sources of an order, and judge the value that it would bring into force. Nothing is kept here."""

from collections.abc import Callable, Collection, Sequence

import msgspec

from appliance.specifications.in_force import Consent, InForce
from appliance.specifications.live_topics import Published, TopicFindings, judge_holds, judge_topics
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    Sources,
    SpecificationsRefusedError,
)
from appliance.specifications.specification_revisions import CheckBeside
from appliance.specifications.switches import SHADOW


class Judge:
    """Judges by the present topics (`live()`) and by the monitors on relays.

    `held()` are monitors that hold their topics, `moved(coming)` the files that go to another relay.
    """

    def __init__(
        self,
        live: Callable[[], Published],
        *,
        held: Callable[[], Collection[str]],
        moved: Callable[[CheckedSpecifications], Collection[str]],
    ) -> None:
        self._live = live
        self._held = held
        self._moved = moved

    def judge(
        self,
        now: InForce,
        coming: InForce,
        shadow: Collection[str],
        consent: Consent,
        *,
        promoted: Collection[str] = (),
    ) -> list[str]:
        """Return the warnings about a value. Raise `SpecificationsRefusedError` if it needs more consent."""
        cut = judge_topics(
            coming.checked, now.checked, self._live(), shadow=shadow, forced=consent.force, promoted=promoted
        )
        held = self.holds(now, coming, shadow, hold=consent.hold)
        if cut.conflicts or held.conflicts:
            raise SpecificationsRefusedError([*cut.conflicts, *held.conflicts, *cut.warnings, *held.warnings])
        return cut.warnings + held.warnings

    def holds(self, now: InForce, coming: InForce, shadow: Collection[str], *, hold: bool) -> TopicFindings:
        """Judge the topics with traffic that the monitors of a value would hold."""
        acting = {
            name
            for name, state in coming.states.items()
            if now.switches.is_enabled(name) and state and name not in shadow
        }
        return judge_holds(
            coming.checked,
            now.checked,
            self._live(),
            acting=acting - {*self._held()},
            moved=self._moved(coming.checked),
            hold=hold,
        )


async def beside_broken(
    now: InForce, check: CheckBeside, site_keys: Sequence[str], sources: Sources, loaded: Collection[str] = ()
) -> CheckedSpecifications:
    """Let files that have done nothing since the start, because of an error, remain so unless they are `loaded`."""
    present, following = now.sources.by_name(), sources.by_name()
    errors = {
        file: error
        for file, error in broken_files(now).items()
        if file not in loaded and following.get(file) == present.get(file)
    }
    try:
        checked = await check(sources, site_keys, [file for file in errors if file in sources.files])
    except SpecificationsRefusedError as error:
        raise SpecificationsRefusedError([*error.findings, *map(_idle, errors)]) from error
    unusable = {file: error for file, error in errors.items() if file not in following}
    left_out = unusable | checked.left_out
    idle = left_out.keys() | {checked.monitors[name] for name in checked.unbuilt}
    warnings = [_idle(file) for file in errors if file in idle]
    return msgspec.structs.replace(checked, left_out=left_out, warnings=(*checked.warnings, *warnings))


def broken_files(now: InForce) -> dict[str, str]:
    """Return the files that do nothing, because they have an error."""
    unbuilt = {now.checked.monitors[name]: error for name, error in now.checked.unbuilt.items()}
    return now.checked.left_out | unbuilt


def in_shadow(coming: InForce, files: Collection[str] = ()) -> set[str]:
    monitors = coming.checked.monitors.items()
    return {name for name, file in monitors if coming.states[name] == SHADOW or file in files}


def _idle(file: str) -> str:
    fix = f"when it is corrected: rosrv monitor load {file}"
    return f"{file}:1:1: warning: it does nothing, because it has an error; {fix}"
