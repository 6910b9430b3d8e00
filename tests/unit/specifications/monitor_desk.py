"""Orders about monitors as text, for a control and the controls that follow it, with a relay that accepts everything.

Orders (`Dialogue.say`): `b` is the file b.rv with the text `b` of `TEXTS`, `c.rv:u` the file c.rv with the text `u`.

    start [enable=none] [restarted] [no-folder]     a control starts
    folder b | folder c.rv:u |    folder -b         write or delete a file of the folder
    live /other /talker std_msgs/Int32              a node publishes a topic
    relay no | relay yes | relay away               the relay refuses every statement, takes it, or is away
    relay begins b                                  its answers name the monitors that began in their initial state
    relay starts | relay takes 1 held=b             another relay is sent its statement; its answer
    revisions                                       list the kept revisions
    eve load b shadow confirm_within=1e-9           an operator's order, with fields of its request
    revision 3                                      the time limit of a change ends; its rollback is this revision
    given LINE                                      another order, whose effects are not listed

Effects follow: the answer (or refusal), the statements to the relay, the records, and the monitors if they have
changed.
"""

import asyncio
import shlex
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import asdict

from appliance.base.actors import UNCONFIRMED
from appliance.channel import admin, messages
from appliance.channel.answers.monitor_answers import Replaced
from appliance.specifications.allocation import Allocation, Move, Resource
from appliance.specifications.checking import check, contents, contents_at_start, contents_beside
from appliance.specifications.live_topics import LiveType, Published
from appliance.specifications.rollout import Parts
from appliance.specifications.specification_files import (
    CheckedSpecifications,
    MonitorsChangedError,
    Sources,
    SpecificationsRefusedError,
)
from appliance.specifications.specification_manager import (
    SpecificationManager,
    UnknownMonitorError,
)
from appliance.specifications.specification_revisions import Check, CheckBeside
from appliance.store.state_file import StateStore
from tests.support.audit import RecordingTrail
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase, open_log
from tests.support.stated import parts_here

A = "a() { int shared; event said() /chatter std_msgs/String '{}' { } }"
B = "hold b() { event said() /other std_msgs/String '{}' { } }"
C = "c() { event said() /third std_msgs/String '{}' { } }"
USER = "u() { event said() /chatter std_msgs/String '{}' { shared = 1; } }"
S = "s() { int n; event said() /cmd std_msgs/String '{}' { n++; if (n > 9) { return; } } }"
TEXTS = {
    "s": S, "s2": S.replace("9", "8"), "a": A, "a2": A.replace("{", "{ int n;", 1), "b": B, "c": C, "u": USER,
    "v": USER.replace("u()", "v()"), "c-user": C.replace("{ }", "{ shared = 2; }"),
    "c-and-d": USER.replace("u()", "c()") + "\nd() { event said() /x std_msgs/String '{}' { } }",
    "c-unknown": "c() { event e() /x nobody/Knows '{}' { } }", "nonsense": "nonsense",
}  # fmt: skip


@cache
def _checked(sources: bytes, site_keys: tuple[str, ...], broken: tuple[str, ...]) -> CheckedSpecifications:
    compiler = partial(contents_beside, broken=broken) if broken else contents
    return check(msgspec.json.decode(sources, type=Sources), site_keys, compiler=compiler)


async def here(
    sources: Sources, site_keys: Sequence[str], broken: Sequence[str] = ()
) -> CheckedSpecifications:
    return await asyncio.to_thread(_checked, msgspec.json.encode(sources), (*site_keys,), (*broken,))


async def here_at_start(
    sources: Sources, site_keys: Sequence[str], known: Sequence[str] | None = None
) -> CheckedSpecifications:
    compiler = partial(contents_at_start, lints=known is None)
    checked = await asyncio.to_thread(check, sources, site_keys, compiler=compiler)
    return checked if known is None else msgspec.structs.replace(checked, warnings=tuple(known))


class SlowCompiler:
    """A compiler that says when it has `begun`, and waits until it `goes_on`."""

    def __init__(self) -> None:
        self.begun, self.goes_on = asyncio.Event(), asyncio.Event()

    async def __call__(self, *order: Any) -> CheckedSpecifications:
        self.begun.set()
        await self.goes_on.wait()
        return await here(*order)


class Desk:
    def __init__(self, home: Path) -> None:
        self.home, self.folder = home, home / "monitors"
        self.folder.mkdir()
        (self.folder / "a.rv").write_text(A)
        self.log = open_log(home / "audit.db")
        self.trail = RecordingTrail(self.log)
        self.store = StateStore(home, failed=pytest.fail, kind=InlineDatabase)
        self._ending: asyncio.Task[None] | None = None
        self.sent: list[messages.Message] = []
        self.findings: list[str] = []
        self.began: list[str] = []
        self.away = False
        self.carried_out = asyncio.Event()
        self.carried_out.set()
        self.limit_ends, self.rolled_back = asyncio.Event(), asyncio.Event()
        self.limit_ends.set()
        self.try_out: CheckBeside = here
        self.check: CheckBeside = here
        self.check_at_start: Check = here_at_start
        self.parts: Parts = parts_here
        self.relays = 1
        self.live: Published = {}

    async def monitors(
        self,
        enable: str = "all",
        *,
        restarted: bool = False,
        taken_over: bool = False,
        folder: bool = True,
        site_keys: Sequence[str] = (),
    ) -> SpecificationManager:
        relay = Taking(self)
        self.kill()
        ends = ends_of(self.store, self.home)
        self._ending = asyncio.create_task(ends.run())
        relay.monitors = WaitingManager(
            self.folder if folder else None,
            enable,
            self.store,
            ends,
            self.trail,
            on_fault="drop",
            slices=1000,
            allocation=Allocation(self.relays),
            relays=relay,
            published=lambda: None,
            told=[],
            site_keys=site_keys,
            check=lambda sources, keys, broken: self.check(sources, keys, broken),  # noqa: PLW0108  of whatever it is then
            check_at_start=self.check_at_start,
            try_out=self.try_out,
            parts=self.parts,
            live=lambda: self.live,
        )
        relay.monitors.desk = self
        await relay.monitors.start(restarted=restarted, taken_over=taken_over)
        return relay.monitors

    def kill(self) -> None:
        """Let the last control end no more timed switches."""
        if self._ending is not None:
            self._ending.cancel()

    def close(self) -> None:
        self.store.close()
        self.log.close()


class WaitingManager(SpecificationManager):
    desk: Desk

    async def roll_back(self, request: admin.MonitorRollback, who: str) -> Replaced:
        if who != UNCONFIRMED:
            return await super().roll_back(request, who)
        await self.desk.limit_ends.wait()
        replaced = await super().roll_back(request, who)
        self.desk.rolled_back.set()
        return replaced


class Taking:
    monitors: WaitingManager

    def __init__(self, desk: Desk) -> None:
        self.desk = desk

    def send(self, message: messages.Message, relay: int) -> bool:
        if self.desk.away:
            return False
        self.desk.sent.append(message)
        if isinstance(message, messages.SpecificationsStated):
            answer: messages.Message = messages.SpecificationsTaken(
                message.revision, self.desk.began, [], message.statement
            )
            if self.desk.findings:
                answer = messages.SpecificationsRefused(
                    message.revision, self.desk.findings, message.statement
                )
            asyncio.get_running_loop().call_soon(self.monitors.received, answer, relay)
        return True

    async def carried_out(self) -> None:
        await self.desk.carried_out.wait()

    def live_resources(self) -> set[Resource]:
        return set()

    def withdraw(self, moves: Sequence[Move]) -> None: ...
    def place(self, moves: Sequence[Move]) -> None: ...


_ORDERS: dict[str, tuple[str, type[Any], dict[str, Any]]] = {
    "load": ("load", admin.MonitorLoad, {}), "try": ("attempt", admin.MonitorLoad, {}),
    "reload": ("reload", admin.MonitorReload, {}), "remove": ("remove", admin.MonitorRemove, {}),
    "rollback": ("roll_back", admin.MonitorRollback, {}), "confirm": ("confirm", admin.MonitorConfirm, {}),
    "enable": ("switch", admin.MonitorSwitch, {"enabled": True}),
    "disable": ("switch", admin.MonitorSwitch, {"enabled": False}),
    "shadow": ("shadow", admin.MonitorShadow, {"shadow": True}),
    "promote": ("shadow", admin.MonitorShadow, {"shadow": False}), "resume": ("resume", admin.MonitorResume, {}),
}  # fmt: skip
_FLAGS = {"shadow", "force", "prune", "hold"}


def _file(word: str) -> tuple[str, str]:
    name, _, text = word.partition(":")
    return (name, TEXTS[text]) if text else (f"{name}.rv", TEXTS[name])


class Dialogue:
    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        desk.limit_ends.clear()
        self._monitors: SpecificationManager | None = None
        self._last = ""

    async def say(self, line: str) -> list[str]:
        if line.startswith("given "):
            await self.say(line.removeprefix("given "))
            return []
        self.desk.sent.clear()
        self.desk.trail.heard.clear()
        effects = await self._done(shlex.split(line))
        for _ in range(3):  # a relay answers in the next turn
            await asyncio.sleep(0)
        now = self._now()
        effects += [*map(_shown, self.desk.sent), *(_record(*one) for one in self.desk.trail.heard)]
        if now != self._last:
            effects.append(now)
        self._last = now
        return effects

    async def _done(self, said: list[str]) -> list[str]:
        desk = self.desk
        match said:
            case ["start", *how]:
                await desk.store.until_settled()
                given: dict[str, Any] = dict(word.split("=") for word in how if "=" in word)
                start = desk.monitors(restarted="restarted" in how, folder="no-folder" not in how, **given)
                try:
                    self._monitors, self._last = await start, ""
                except SpecificationsRefusedError as refusal:
                    return _refused(refusal)
            case ["folder", word] if word.startswith("-"):
                (desk.folder / f"{word[1:]}.rv").unlink()
            case ["folder", word]:
                name, text = _file(word)
                (desk.folder / name).write_text(text)
            case ["live", topic, node, kind]:
                desk.live = {**desk.live, topic: {node: LiveType(kind)}}
            case ["relay", "no" | "yes" | "away" as how]:
                desk.away, desk.findings = how == "away", ["the relay says no"] if how == "no" else []
            case ["relay", "begins", *names]:
                desk.began = names
            case ["relay", "starts"]:
                desk.sent.append(self.monitors.statement(0))
            case ["revisions"]:
                rows = (await self.monitors.revisions(admin.MonitorRevisions())).revisions
                return [f"revision {row.revision} by {row.who}: {row.note}" for row in rows]
            case ["relay", "takes", revision, *how]:
                fields = {key: value.split(",") for key, value in (word.split("=") for word in how)}
                taken = messages.SpecificationsTaken(
                    int(revision), fields.get("began", []), fields.get("held", [])
                )
                self.monitors.received(taken)
            case ["revision", number]:
                desk.limit_ends.set()
                async with asyncio.timeout(30):
                    await desk.rolled_back.wait()
                desk.limit_ends.clear()
                desk.rolled_back.clear()
                assert self.monitors.revision == int(number)
            case [who, verb, *words]:
                return await self._ordered(who, verb, words)
        return []

    @property
    def monitors(self) -> SpecificationManager:
        assert self._monitors is not None
        return self._monitors

    async def _ordered(self, who: str, verb: str, words: list[str]) -> list[str]:
        method, request, fixed = _ORDERS[verb]
        fields: dict[str, Any] = dict(fixed)
        fields |= {word: True for word in words if word in _FLAGS}
        fields |= dict(word.split("=") for word in words if "=" in word)
        plain = [word for word in words if word not in _FLAGS and "=" not in word]
        if verb in ("load", "try"):
            fields["files"] = dict(map(_file, plain))
        elif verb == "rollback":
            fields["revision"] = plain[0] if plain else None
        elif plain:
            fields["names"] = plain
        try:
            order = msgspec.convert(fields, request, strict=False)
            answer = await getattr(self.monitors, method)(
                admin.MonitorTry(order) if verb == "try" else order, who
            )
        except (SpecificationsRefusedError, UnknownMonitorError, MonitorsChangedError) as refusal:
            return _refused(refusal)
        given = {key: value for key, value in asdict(answer).items() if value and key not in _VARYING}
        given.pop("monitors" if verb != "try" else "", None)
        limit = ["to confirm"] if getattr(answer, "confirm_by", None) else []
        return [f"answer {_words(given)}".strip(), *limit]

    def _now(self) -> str:
        if self._monitors is None:
            return ""
        one, states = self.monitors, self.monitors.switches.states
        shown = [f"{name}={_STATES.get(states[name], states[name])}" for name in one.names()]
        extra = {
            "to be confirmed": one.confirm_by is not None,
            "differs from the folder": one.differs_from_folder,
            f"holds {','.join(sorted(one.rollout.held))}": bool(one.rollout.held),
            f"switched off {','.join(one.switches.switched_off())}": bool(one.switches.switched_off()),
        }
        said = "".join(f"; {text}" for text, holds in extra.items() if holds)
        return f"now {one.tag} by {one.in_force.who or 'nobody'}: {' '.join(shown) or 'nothing'}{said}"


_VARYING = {"confirm_by", "tag", "loaded"}
_STATES = {True: "on", False: "off", "shadow": "shadow"}
_RECORDED = ("who", "monitor", "began", "held", "count", "lost")


def _words(fields: dict[str, Any]) -> str:
    shown = {
        key: ",".join(map(str, value)) if isinstance(value, list) else value for key, value in fields.items()
    }
    return " ".join(f"{key}={value}" for key, value in shown.items())


def _refused(refusal: Exception) -> list[str]:
    match refusal:
        case MonitorsChangedError():
            how = f"outdated, now {refusal.tag}"
        case UnknownMonitorError():
            how = "unknown"
        case _:
            how = "refused"
    return [f"{how}: {line}" for line in str(refusal).splitlines()]


def _shown(message: messages.Message) -> str:
    if isinstance(message, messages.SpecificationsStated):
        states = {name: "on" if on else "off" for name, on in message.enabled.items()}
        states |= {
            name: "shadow" if states.get(name) == "on" else "off and in shadow" for name in message.shadows
        }
        restarted = " restarted" if message.restarted else ""
        return f"relay {message.revision}{restarted}: {_words(states)}".strip()
    return f"relay {message}"


def _record(event: str, fields: dict[str, Any]) -> str:
    given = {key: fields[key] for key in _RECORDED if fields.get(key)}
    return f"record {event}: {_words(given)}".strip()
