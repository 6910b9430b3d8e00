"""Bring verified bundles of the fleet into force, through the same gate as local loads.

1. Before the first change, `BundleRecord.trial` is on the disk, with everything that a rollback needs. If control or
   the appliance ends during a trial, the next start rolls back.
2. The bundle in force changes in one write, at the end of a trial in which the robot stayed healthy.
3. A rollback never undoes a change that an operator made during the trial.
4. A refused bundle changes nothing; the last good one stays in force. No bundle is refused because the robot is worse
   than in a minute that control does not know.
5. A bundle whose monitors would hold topics with traffic is not loaded yet: the robot would get no command, not even
   a stop.
6. With `bundles.wait_for_order`, each try of a bundle needs an order of an operator on the robot.
"""

import asyncio
from collections.abc import Callable, Iterator, Mapping

import msgspec
import structlog

from appliance.base import clock
from appliance.base.actors import UNCONFIRMED
from appliance.base.counted import counted
from appliance.channel import admin
from appliance.channel.link import Link
from appliance.control.assembly.policies import Policies, PolicyCases, RevisionChangedError
from appliance.control.errors import PolicyRefusedError
from appliance.features.fleet.bundle_health import RobotHealth
from appliance.features.fleet.bundle_link import (
    BundleHealth,
    BundleOffered,
    BundlePollReported,
    BundleStated,
    RefusedBundle,
)
from appliance.features.fleet.settings import Fleet
from appliance.features.fleet.view import BundlesState
from appliance.formats.bundle_archive import BundleContents
from appliance.hosts.host_table import HostRefusedError
from appliance.hosts.hosts_file import IN_BUNDLE, DeclaredHostsError, parse_declared
from appliance.hosts.tunnel_hosts import TunnelHosts
from appliance.policy.commands import COMMANDS
from appliance.policy.keys import Key
from appliance.policy.model import Address, Category, Request
from appliance.policy.policy import Policy
from appliance.signing.fingerprints import fingerprint
from appliance.specifications.specification_files import (
    MonitorsChangedError,
    Sources,
    SpecificationsRefusedError,
)
from appliance.specifications.specification_manager import SpecificationManager
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

# Find the rights that a new policy takes from a host, by deciding sample names for each rule.

_ANY = "any_name"  # stands for the stars of a key


class LostRights:
    """Compares two policies, without their blocks, holders and approvals."""

    def __init__(self, old: Policy, new: Policy) -> None:
        self.old, self.new = old, new
        self._names = {category: tuple(dict.fromkeys(_names(old, new, category))) for category in Category}
        self._before, self._after = old.plain(), new.plain()
        self._lost: dict[tuple[str, str], bool] = {}  # by the networks that both policies name

    def took_from(self, host: Address) -> bool:
        networks = self.old.alike(host), self.new.alike(host)
        if networks not in self._lost:
            self._lost[networks] = any(
                self._before.decide(request).allowed and not self._after.decide(request).allowed
                for category, names in self._names.items()
                for request in (Request(host, "", category, name) for name in names)
            )
        return self._lost[networks]


def _names(old: Policy, new: Policy, category: Category) -> Iterator[str]:
    if category is Category.COMMAND:
        yield from COMMANDS
        return
    yield from (f"/{_ANY}", f"/{_ANY}/{_ANY}", f"/{_ANY}/{_ANY}/{_ANY}")  # mostly decided by the default
    yield from (name for policy in (old, new) for group in policy.authority.values() for name in group.names)
    for rule in (*old.rules(category), *new.rules(category)):
        if rule.key is not None:
            yield from _matching(rule.key)


def _matching(key: Key) -> Iterator[str]:
    if key.exact:
        yield key.text
        return
    for word in (_ANY, "") if all(text for text, _star in key.steps) else (_ANY,):
        steps = "".join(f"/{text}{word if star else ''}" for text, star in key.steps)
        yield from (steps, f"{steps}/{_ANY}", f"{steps}/{_ANY}/{_ANY}") if key.subtree else (steps,)


_log = structlog.get_logger()
_SETTING = "fleet bundle"
_TICK_SECONDS = 1.0
_AGAIN_SECONDS = 5.0
_KNOWN_SECONDS = 60.0  # the time of `LastMinute`
_INTERRUPTIONS = 3  # trials of one bundle that may end with the process before the bundle is refused
_REFUSALS = (
    DeclaredHostsError,
    HostRefusedError,
    PolicyRefusedError,
    SpecificationsRefusedError,
)
_OUTDATED = (RevisionChangedError, MonitorsChangedError)
_CHANGED_DURING_TRIAL = (
    "an operator changed the policy or the specifications during commit-confirm; the bundle is rolled back, and tried"
    " again at the next poll"
)
_UNCONFIRMED_CHANGE = "a local change waits for its confirmation; the bundle waits for it"


class _OperatorChangeError(Exception):
    """An operator changed a part of the bundle during its commit-confirm."""


class _UnknownBeforeError(Exception):
    """The robot became worse than in a minute of which control does not know the whole."""


class Trial(msgspec.Struct, frozen=True):
    """A bundle in its commit-confirm period, and the state before it."""

    path: str
    sha256: str
    policy_back: int
    monitors_back: int
    hosts_back: str
    """Empty: the robot's own hosts.yaml."""
    hosts_sha256: str

    @property
    def who(self) -> str:
        return f"bundle {self.path}"


class BundleRecord(msgspec.Struct, frozen=True):
    """The stored record."""

    in_force: str = ""
    sha256: str = ""
    since: float = 0.0
    policy: int = 0
    monitors: int = 0
    policy_back: int = 0
    """The revision of the policy before the bundle."""
    refused: RefusedBundle | None = None
    trial: Trial | None = None
    interrupted: str = ""
    """The SHA-256 of the bundle whose last `interruptions` trials ended with the process."""
    interruptions: int = 0
    content: str = ""
    """The fingerprint of all parts. Revision numbers do not tell whether a part was changed, because a rollback makes
    a new revision of the same text.
    """


def disabled_among(states: Mapping[str, bool | str]) -> str:
    off = [name for name, state in states.items() if state is False]
    return f"; disabled on this robot: {', '.join(off)} (rosrv monitor enable)" if off else ""


class BundleGate:
    """Control's end of the link to the process `bundles`."""

    def __init__(
        self,
        fleet: Fleet,
        *,
        policies: Policies,
        monitors: SpecificationManager,
        hosts: Callable[[], TunnelHosts],
        store: StateStore,
        trail: AuditTrail,
        # The health without denials of hosts for which the given function returns true.
        health: Callable[[Callable[[Address], bool]], RobotHealth],
    ) -> None:
        self._fleet = fleet
        self._policies, self._monitors, self._hosts = policies, monitors, hosts
        self._store, self._trail, self._measured = store, trail, health
        self._earlier: Policy | None = None  # the policy before the bundle
        self._lost: LostRights | None = None
        self._held = frozenset[str]()  # monitors that hold topics since the bundle replaced them
        self.link = Link(self._heard)
        self._record = msgspec.json.decode(store.settings().get(_SETTING, "{}"), type=BundleRecord)
        self._poll = BundlePollReported()
        self._checked: clock.Began | None = None
        self._stated: BundleStated | None = None
        self._stated_to: object = None
        self._offered: BundleOffered | None = None
        self._there = asyncio.Event()
        self._waits = ""
        self._known = self._rests = 0.0  # when control knows a whole minute; when bundles are tried again
        self._for_order: BundleOffered | None = None
        self._ordered: BundleOffered | None = None
        self._fingerprinted: tuple[object, str] = (None, "")

    def status(self) -> BundlesState | None:
        record, fleet = self._record, self._fleet
        if fleet.bundles.root is None and not record.in_force:
            return None
        trouble = self._poll.trouble or self._waiting
        if fleet.bundles.root is not None and self.link.channel is None:
            trouble = trouble or "the process that polls for bundles is not running yet"
        return BundlesState(
            collector=fleet.collector or "",
            in_force=record.in_force,
            sha256=record.sha256,
            since=record.since or None,
            trying="" if record.trial is None else record.trial.path,
            refused="" if record.refused is None else record.refused.path,
            reason="" if record.refused is None else record.refused.reason,
            changed=self._changed,
            checked=None if self._checked is None else self._checked.date(),
            trouble=trouble,
            rejected=self._poll.rejected,
            for_order=self._waiting_for_order,
        )

    def order(self, path: str, who: str) -> bool:
        """Let the bundle that waits for an order be tried; return whether `path` waits."""
        if self._for_order is None or self._waiting_for_order != path:
            return False
        self._ordered, self._for_order = self._for_order, None
        self._trail.happened("bundle ordered", f"{path} is to be tried", who=who, bundle=path)
        self._there.set()
        return True

    async def run(self) -> None:
        if self._record.trial is not None:
            await self._undo_interrupted(self._record, self._record.trial)
        if self._record.policy_back:
            self._earlier = await self._policies.compile_revision(self._record.policy_back)
        self._known = clock.now() + _KNOWN_SECONDS
        while self._fleet.bundles.root is not None:
            self._state()
            try:
                async with asyncio.timeout(_TICK_SECONDS):
                    await self._there.wait()
            except TimeoutError:
                continue
            self._there.clear()
            ordered, self._ordered = self._ordered, None
            offered, self._offered = self._offered, None
            if ordered is not None:
                await self._take(ordered, ordered=True)
            if offered is not None:
                await self._take(offered)

    # --- the link ---

    def _heard(self, message: object) -> None:
        if isinstance(message, BundleOffered):
            self._offered = message
            self._there.set()
        elif isinstance(message, BundlePollReported):
            self._on_report(message)

    def _on_report(self, message: BundlePollReported) -> None:
        if message.rejected and message.trouble != self._poll.trouble:
            self._trail.happened("bundle metadata rejected", message.trouble, collector=self._fleet.collector)
        if message.checked != self._poll.checked:
            self._checked = clock.Began(message.checked)
        self._poll = message

    def _state(self) -> None:
        record, health = self._record, self._health()
        stated = BundleStated(
            record.in_force,
            record.sha256,
            "" if record.trial is None else record.trial.path,
            record.refused,
            self._changed,
            BundleHealth(health.denials, len(health.failing)),
            self._waiting,
        )
        if (stated, self.link.channel) != (self._stated, self._stated_to):
            self._stated, self._stated_to = stated, self.link.channel
            self.link.send(stated)

    @property
    def _unconfirmed(self) -> bool:
        return self._policies.confirm_by is not None or self._monitors.confirm_by is not None

    @property
    def _waiting(self) -> str:
        """Return why the bundle that the last poll offered waits, or ""."""
        if not self._poll.offered:
            return ""
        if self._unconfirmed:
            return self._waits and _UNCONFIRMED_CHANGE
        return "" if self._waits == _UNCONFIRMED_CHANGE else self._waits

    @property
    def _waiting_for_order(self) -> str:
        """Return the bundle that waits for an order, or ""."""
        return self._for_order.path if self._for_order is not None and self._waiting == self._waits else ""

    @property
    def _changed(self) -> bool:
        record = self._record
        if not record.in_force or record.trial is not None:
            return False
        if record.content:
            return self._content() != record.content
        there = (self._policies.revision, self._monitors.revision)
        return there != (record.policy, record.monitors) or not self._hosts().bundled

    def _content(self) -> str:
        policies, monitors, hosts = self._policies, self._monitors, self._hosts()
        switches = monitors.switches.states_of(monitors.checked)
        given = (policies.revision, monitors.revision, switches, hosts.bundled)
        if self._fingerprinted[0] != given:
            parts = [
                policies.current.text,
                policies.in_force.signature,
                monitors.sources,
                switches,
                hosts.bundled,
            ]
            text = msgspec.json.encode(parts, order="deterministic").decode()
            self._fingerprinted = (given, fingerprint(text))
        return self._fingerprinted[1]

    # --- the gate ---

    async def _take(self, offered: BundleOffered, *, ordered: bool = False) -> None:
        record, contents = self._record, offered.contents
        refused = record.refused
        # The process may have offered the bundle again before it heard of the trial.
        if clock.now() < self._rests or (offered.path, offered.sha256) in (
            (record.in_force, record.sha256),
            refused and (refused.path, refused.sha256),
        ):
            return
        if ordered or self._for_order != offered:  # else it can be ordered during the check
            self._waits, self._for_order = "", None
        if self._unconfirmed:
            self._waits, self._for_order = _UNCONFIRMED_CHANGE, None
            return
        try:
            parse_declared(contents.hosts, IN_BUNDLE)
            await self._policies.attempt(contents.policy, contents.policy_signature, _cases(contents))
            held = await self._monitors.held_by_bundle(_sources(contents))
        except _REFUSALS as error:
            self._waits, self._for_order = "", None
            self._refuse(offered.path, offered.sha256, str(error))
            return
        if self._ordered == offered:  # since the check began: `run` tries it now
            return
        self._waits, self._for_order = "", None
        if held:
            again = "; it then needs another order" if ordered else ""
            self._waits = f"{offered.path} waits until no message passes for a minute: {held[0]}{again}"
            return
        if self._fleet.bundles.wait_for_order and not ordered:
            self._for_order = offered
            self._waits = f"{offered.path} waits for an order: rosrv fleet take"
            return
        trial = Trial(
            offered.path,
            offered.sha256,
            self._policies.revision,
            self._monitors.revision,
            self._hosts().bundled,
            fingerprint(contents.hosts or "\n"),
        )
        tag = self._monitors.tag
        try:
            await self._keep(msgspec.structs.replace(record, trial=trial))
            await self._try(trial, contents, tag)
        except (*_OUTDATED, _OperatorChangeError, _UnknownBeforeError, StoreError) as error:
            # It says nothing about the bundle, which is offered again.
            has_text = isinstance(error, StoreError | _UnknownBeforeError)
            self._waits = str(error) if has_text else _CHANGED_DURING_TRIAL
            # Before the rollback: after a crash in between, the next start rolls back.
            self._save(msgspec.structs.replace(record, trial=trial))
            await self._end(trial)
            self._save(record)
            if isinstance(error, _UnknownBeforeError):
                self._rests = clock.now() + _KNOWN_SECONDS  # until the last minute has nothing of the trial

    async def _try(self, trial: Trial, contents: BundleContents, tag: str) -> None:
        before, self._earlier = self._health(), self._policies.current
        is_known = clock.now() >= self._known
        try:
            there = await self._put_in_force(trial, contents, tag)
            self._held = frozenset(self._monitors.rollout.held - before.failing)
            reason = await self._watch(before, there)
            if reason and not is_known:
                raise _UnknownBeforeError(
                    f"{trial.path} is rolled back, and tried again at a poll after a minute, because it was tried right"
                    f" after a start of the appliance: {reason}"
                )
        except _REFUSALS as error:
            reason = str(error)
        if reason:
            await self._end(trial)
            self._refuse(trial.path, trial.sha256, reason)
            return
        policy, monitors = there
        earlier, earlier_sha256 = self._record.in_force, self._record.sha256
        await self._keep(
            BundleRecord(
                trial.path,
                trial.sha256,
                clock.wall(),
                policy,
                monitors,
                policy_back=trial.policy_back,
                content=self._content(),
            )
        )
        without = disabled_among(self._monitors.switches.states)
        self._trail.happened(
            "bundle in force",
            f"{trial.path} is in force, healthy for {self._fleet.bundles.confirm_seconds:g} s{without}",
            bundle=trial.path,
            sha256=trial.sha256,
            earlier=earlier,
            earlier_sha256=earlier_sha256,
            revision_of_specifications=monitors,
        )

    async def _put_in_force(self, trial: Trial, contents: BundleContents, tag: str) -> tuple[int, int]:
        """Load all parts of a bundle, in order; return its revisions of the policy and the specifications.

        If one of `_REFUSALS` or `_OUTDATED` is raised, the earlier parts are in force. `tag` is that of the monitors to
        which the trial would go back: what an operator loads later is not lost.
        """
        monitors = await self._monitors.take_bundle(_sources(contents), trial.who, "of the bundle", tag)
        load = admin.PolicyLoad(
            contents.policy, "of the bundle", expected=trial.policy_back, signature=contents.policy_signature
        )
        policy = await self._policies.load_with(load, trial.who, _cases(contents))
        await self._hosts().take_bundle(contents.hosts or "\n", trial.who)
        return policy.revision, monitors.revision

    async def _watch(self, before: RobotHealth, there: tuple[int, int]) -> str:
        deadline = clock.now() + self._fleet.bundles.confirm_seconds
        while True:
            if there != (self._policies.revision, self._monitors.revision):
                raise _OperatorChangeError
            reason = self._health().worse_than(before)
            if reason or clock.now() >= deadline:
                return reason
            self._state()
            await asyncio.sleep(min(_TICK_SECONDS, max(0.0, deadline - clock.now())))

    def _health(self) -> RobotHealth:
        """Return the health without the expected effects of the bundle: denials of hosts that lost a right, and
        monitors that hold topics because they lost their state.
        """
        old, new, lost = self._earlier, self._policies.current, self._lost
        if old is None:
            return self._measured(lambda _host: False)
        if lost is None or (lost.old, lost.new) != (old, new):
            lost = self._lost = LostRights(old, new)
        health = self._measured(lost.took_from)
        return health._replace(failing=health.failing - self._held)

    def _refuse(self, path: str, sha256: str, reason: str) -> None:
        refused = RefusedBundle(path, sha256, reason[:4000])
        self._save(msgspec.structs.replace(self._record, refused=refused, trial=None))
        stays = self._record.in_force or "no bundle"
        self._trail.happened(
            "bundle refused",
            f"{path} is refused, {stays} stays in force: {reason.splitlines()[0] if reason else ''}",
            bundle=path,
            sha256=sha256,
            stays=stays,
            findings=reason.splitlines()[:100],
        )

    # --- going back ---

    async def _undo_interrupted(self, record: BundleRecord, trial: Trial) -> None:
        await self._undo(trial)
        interruptions = 1 + (record.interruptions if record.interrupted == trial.sha256 else 0)
        self._save(
            msgspec.structs.replace(record, trial=None, interrupted=trial.sha256, interruptions=interruptions)
        )
        if interruptions >= _INTERRUPTIONS:
            reason = f"the appliance ended during each of {counted(interruptions, 'trial')}"
            self._refuse(trial.path, trial.sha256, reason)

    async def _end(self, trial: Trial) -> None:
        self._earlier, self._held = None, frozenset()
        await self._undo(trial)

    async def _undo(self, trial: Trial) -> None:
        """Roll back to the state before the trial, except for parts that an operator has changed."""
        policies, monitors = self._policies, self._monitors
        while True:
            try:
                if policies.in_force.who == trial.who and policies.revision > trial.policy_back:
                    policy = admin.PolicyRollback(trial.policy_back, policies.revision)
                    await policies.roll_back(policy, UNCONFIRMED)
                if monitors.in_force.who == trial.who and monitors.revision > trial.monitors_back:
                    await monitors.roll_back(
                        admin.MonitorRollback(trial.monitors_back, monitors.tag), UNCONFIRMED
                    )
                if fingerprint(self._hosts().bundled) == trial.hosts_sha256 and (
                    self._hosts().bundled != trial.hosts_back
                ):
                    await self._hosts().take_bundle(trial.hosts_back, UNCONFIRMED)
            except (*_REFUSALS, *_OUTDATED, StoreError) as error:
                _log.error("a bundle cannot be rolled back yet", bundle=trial.path, error=str(error))
                await asyncio.sleep(_AGAIN_SECONDS)
            else:
                return

    async def _keep(self, record: BundleRecord) -> None:
        self._save(record)
        await self._store.until_settled()

    def _save(self, record: BundleRecord) -> None:
        self._record = record
        self._store.save_setting(_SETTING, msgspec.json.encode(record).decode())


def _sources(contents: BundleContents) -> Sources:
    return Sources(contents.files, contents.definitions, contents.signatures)


def _cases(contents: BundleContents) -> PolicyCases:
    return PolicyCases("policy.ini.tests.yaml", contents.cases)
