"""Worlds of the guards that follow a word of each node: an enabling device, the mode, a part that is well or not."""

import math
from dataclasses import dataclass
from typing import ClassVar

from lab.closed_loop.messages import BOOL, JOY, STILL, VELOCITIES, Legs, boolean, diagnostics, joy, straight
from lab.closed_loop.world import NEVER, SLACK, World
from tests.support.features.guards.running_guard import Value

TICK = 20
"""Milliseconds between two looks of these guards."""


@dataclass
class Switch:
    """The last word of a node on the topic of a switch."""

    on: bool = False
    heard: int = NEVER
    was_off: bool = False
    """Whether it has said `false` since it was last silent."""


class SwitchWorld(World):
    """Switches of one or two nodes, and one or two nodes that drive."""

    silent: float
    """Seconds; 0: a switch may be silent."""
    live: bool

    def begun(self) -> None:
        self.forgot = NEVER
        self.switches: dict[int, Switch] = {}
        self.ready: set[int] = set()
        """Nodes that have stood, or were slow, since the last stop."""
        self.passing = self.sent = 0
        self.publishers = self.seed % (2 if self.live else 3)

    def unheard(self, slack: int) -> bool:
        return len(self.switches) < max(self.publishers, 1) and self.now >= self.forgot + slack

    def common(self) -> "dict[str, Value]":
        """Return values that several of these guards have, of which one may change."""
        r = self.random
        self.zero_first = self.live or r.random() < 0.8
        if not self.live and r.random() < 0.15:
            self.after(r.uniform(1500, 6000), self._forget)
        return {
            "silent": self.silent, "publishers": self.publishers, "zeroFirst": self.zero_first,
            "forget": r.choice((0, 7)),
        }  # fmt: skip

    def _forget(self) -> None:
        self.trace("the guard is told to forget all nodes")
        self.guard.give("forget", 3)
        self.forgot = self.now
        self.switches.clear()
        self.ready.clear()

    def drives(self, nodes: tuple[int, ...], speeds: tuple[float, ...]) -> None:
        r = self.random
        for node in nodes:
            period = r.choice((20, 50, 100))
            stubborn = not self.live and r.random() < 0.3

            def send(node: int = node, stubborn: bool = stubborn) -> None:
                stands = self.stands() or (not self.live and not stubborn and r.random() < 0.12)
                turning = 0.0 if self.live else r.choice((0.0, 0.0, 0.4))
                self.drive(STILL if stands else self.motion(r.choice(speeds), turning), node)

            self.every(lambda period=period: period * r.uniform(0.8, 1.2), send, first=r.uniform(0, 100))  # type: ignore[misc]  # bound now

    def motion(self, speed: float, turning: float) -> Legs:
        return straight(speed, turning)

    def stands(self) -> bool:
        """Whether an honest node stands now."""
        return False

    def says(self, node: int, on: bool) -> None:
        switch = self.switches.setdefault(node, Switch())
        if self.silent and self.now > switch.heard + self.silent * 1000:
            switch.was_off = False
        switch.on, switch.heard = on, self.now
        switch.was_off = switch.was_off or not on
        self.heard(switch)
        self.say("by", self.word(on), node)

    def word(self, on: bool) -> bytes:
        return boolean(on)

    def heard(self, switch: Switch) -> None:
        """Note what a switch says, before the guard gets it."""

    def quiet(self, slack: int = 0) -> list[int]:
        limit = self.silent * 1000 + slack
        return [node for node, one in self.switches.items() if self.silent and self.now > one.heard + limit]

    def cut(self) -> None:
        self.trace("a switch sends bytes that are no message")
        self.say("by", b"", 3, whole=False)
        self.begins_again()

    def begins_again(self) -> None:
        super().begins_again()
        self.switches.clear()
        self.ready.clear()


class EnableWorld(SwitchWorld):
    """Enabling devices that are held, let go, tied down or silent: the base moves only while all are held."""

    preset: ClassVar[str] = "hold_to_run"

    def plan(self) -> None:
        r = self.random
        self.kind = r.choice(VELOCITIES)
        self.live = r.random() < 0.15
        self.silent = round(r.uniform(0.1, 0.5), 2)
        self.begun()
        self.values()
        self.drives((1,) if self.live or r.random() < 0.5 else (1, 2), (0.5,))
        for node in (3,) if self.live or r.random() < 0.6 else (3, 4):
            self._device(node)
        if not self.live:
            self.interrupt(0.4)

    def values(self) -> None:
        self.joy = self.random.random() < 0.3
        self.button = self.random.choice((0, 5))
        self.guard_with({**self.common(), "button": self.button}, {"by": JOY if self.joy else BOOL})

    def word(self, on: bool) -> bytes:
        return joy([on == (number == self.button) for number in range(8)]) if self.joy else super().word(on)

    def stands(self) -> bool:
        return self.live and self.now < 1500

    def _device(self, node: int) -> None:
        r = self.random
        habit = "person" if self.live else r.choice(("person", "person", "person", "tied"))
        period = self.silent * r.uniform(300, 800)
        changes = [800.0 if self.live else r.uniform(100, 1500)]
        while not self.live and changes[-1] < self.span:
            held_now = len(changes) % 2 == 1
            changes.append(changes[-1] + (r.uniform(500, 4000) if held_now else r.uniform(100, 800)))
        dies = self.span + 1 if self.live or r.random() < 0.6 else r.uniform(1500, 7000)
        quiet_from = r.uniform(1000, 6000) if not self.live and r.random() < 0.4 else self.span + 1.0
        quiet_until = quiet_from + r.choice((250, 600, 1500))

        def held() -> bool:
            return habit == "tied" or sum(self.now >= at for at in changes) % 2 == 1

        def tell() -> None:
            if not quiet_from <= self.now < quiet_until:
                self.says(node, held())

        self.every(
            lambda: -1 if self.now > dies else period * r.uniform(0.6, 1), tell, first=r.uniform(0, 300)
        )
        for at in changes:
            if at < dies:
                self.after(at, tell)

    def heard(self, switch: Switch) -> None:
        if not switch.on:
            self.ready.clear()

    def says(self, node: int, on: bool) -> None:
        super().says(node, on)
        if not on and not self.switched_off and self.moves(self.force[1]):
            self.breach("L3", "a device is let go, and the base is not stopped at once")

    def _why_not(self, slack: int = 0) -> tuple[str, str] | None:
        """Return the law and the reason that nothing may move."""
        law = "L4" if len(self.switches) > 1 else "L2"
        if self.unheard(slack):
            return law, "a device has not said a word"
        if quiet := self.quiet(slack):
            return law, f"the device of node {quiet[0]} is silent"
        for node, switch in self.switches.items():
            if not switch.on:
                return law, f"the device of node {node} is let go"
            if not switch.was_off:
                return "L6", f"the device of node {node} was never let go"
        return None

    def passed(self, node: int, wanted: Legs, got: Legs | None) -> None:
        why = self._why_not()
        if why:
            self.ready.clear()
        elif not self.moves(wanted) and not self.guard.holds:
            self.ready.add(node)
        if got is not None and self.moves(got):
            if late := self._why_not(SLACK):
                self.breach(late[0], f"a motion passes, and {late[1]}")
            if node not in self.ready and not why and self.zero_first:
                self.breach("L6", f"a motion of node {node} passes that has not stood since the last stop")
        if self.live and self.now > 2000:
            self.sent, self.passing = self.sent + 1, self.passing + (got == wanted)

    def watch(self) -> None:
        self.only_fresh()
        why = self._why_not(TICK + SLACK)
        if why and self.quiet():
            self.ready.clear()
        if (
            why
            and not self.switched_off
            and self.moves(self.force[1])
            and self.now > self.fresh_from + 100 + SLACK
        ):
            self.breach(why[0], f"a motion stays in force, and {why[1]}")

    def resume_guard(self) -> None:
        super().resume_guard()
        self.ready.clear()

    def restart(self) -> None:
        super().restart()
        self.ready.clear()

    def ended(self) -> None:
        if self.live and self.passing < 0.95 * self.sent:
            self.breach("live", f"of {self.sent} commands with a held device {self.passing} pass")


class DiagnosticsWorld(EnableWorld):
    """Parts of a base that are well, at ERROR or silent: each is a device that need not be let go first."""

    preset: ClassVar[str] = "diagnostics"

    def values(self) -> None:
        self.publishers = 1
        self.named, self.warnings = self.random.choice(("*", "motor", "mot*")), self.random.random() < 0.3
        self.guard_with({**self.common(), "named": self.named, "warnings": self.warnings})

    def word(self, on: bool) -> bytes:
        bad, well = (1, 2, 3, 4, -1), (0, 0, 1)
        level = self.random.choice(
            (well[: 2 if self.warnings else 3]) if on else bad[0 if self.warnings else 1 :]
        )
        return diagnostics(level, 0 if self.named == "*" else self.random.choice((0, 2)))

    def unheard(self, slack: int) -> bool:
        return (
            not self.switches and self.now >= self.forgot + slack
        )  # it has no `publishers`: a part that never speaks is not known

    def heard(self, switch: Switch) -> None:
        switch.was_off = True
        super().heard(switch)


class ModeWorld(SwitchWorld):
    """Switches between manual and automatic mode: in manual mode, the norm of the velocities has a limit."""

    preset: ClassVar[str] = "mode"

    def plan(self) -> None:
        r = self.random
        self.kind = r.choice(VELOCITIES)
        self.live = r.random() < 0.15
        self.silent = 1.0 if self.live else r.choice((0.0, 0.3, 1.0))
        self.most, self.turn = round(r.uniform(0.1, 0.5), 2), round(r.uniform(0.2, 1), 2)
        self.begun()
        self.guard_with({**self.common(), "vMax": self.most, "wMax": self.turn})
        self.drives(
            (1,) if self.live or r.random() < 0.5 else (1, 2),
            (1.5,) if self.live else (self.most * 0.9, 0.7, 1.5, 9.0, 1e300, math.inf, math.nan),
        )
        for node in (3,) if self.live or r.random() < 0.5 else (3, 4):
            self._switch(node)
        if not self.live:
            self.interrupt(0.35)

    def motion(self, speed: float, turning: float) -> Legs:
        if self.live or self.kind.startswith("ackermann"):
            return straight(speed, turning)
        angle = self.random.uniform(-math.pi, math.pi)
        return (speed * math.cos(angle), speed * math.sin(angle), 0.0, 0.0, 0.0, turning)

    def stands(self) -> bool:
        return self.live and self.now < 1500

    def _switch(self, node: int) -> None:
        r = self.random
        period = (self.silent or 0.5) * r.uniform(300, 800)
        changes = [] if self.live else sorted(r.uniform(0, self.span) for _ in range(r.choice((0, 1, 2, 4))))
        dies = self.span + 1 if self.live or r.random() < 0.6 else r.uniform(1500, 7000)

        def tell() -> None:
            self.says(node, sum(self.now >= at for at in changes) % 2 == 1)

        self.every(
            lambda: -1 if self.now > dies else period * r.uniform(0.6, 1), tell, first=r.uniform(0, 300)
        )
        for at in changes:
            if at < dies:
                self.after(at, tell)

    def heard(self, switch: Switch) -> None:
        if switch.on:
            self.ready.clear()

    def says(self, node: int, on: bool) -> None:
        super().says(node, on)
        if on and not self.switched_off and not self._slow(self.force[1]):
            self.breach("L3", "a switch says manual, and the motion in force stays too fast")

    def _slow(self, legs: Legs, most: float = 1 + 1e-6) -> bool:
        turn = 0.0 if self.kind.startswith("ackermann") else math.hypot(*legs[3:])
        return math.hypot(*legs[:3]) <= self.most * most and turn <= self.turn * most

    def _why_not(self, slack: int = 0) -> tuple[str, str] | None:
        law = "L4" if len(self.switches) > 1 else "L2"
        if self.unheard(slack):
            return law, "a node has not said the mode"
        if quiet := self.quiet(slack):
            return law, f"node {quiet[0]}, which says the mode, is silent"
        for node, switch in self.switches.items():
            if switch.on:
                return law, f"node {node} says manual"
        return None

    def passed(self, node: int, wanted: Legs, got: Legs | None) -> None:
        why = self._why_not()
        if why:
            self.ready.clear()
        elif self._slow(wanted, 1.0) and not self.guard.holds:
            self.ready.add(node)
        if got is not None and not self._slow(got):
            if late := self._why_not(SLACK):
                self.breach(late[0], f"a fast motion passes, and {late[1]}")
            if node not in self.ready and not why:
                self.breach("L6", f"a fast motion of node {node} passes that was not slow since manual mode")
            if not all(map(math.isfinite, got)):
                self.breach("L2", "a velocity that is not a number passes")
        if self.live and self.now > 2500:
            self.sent, self.passing = self.sent + 1, self.passing + (got == wanted)

    def watch(self) -> None:
        self.only_fresh()
        why = self._why_not(TICK + SLACK)
        if why and self.quiet():
            self.ready.clear()
        if (
            why
            and not self.switched_off
            and not self._slow(self.force[1])
            and self.now > self.fresh_from + 100 + SLACK
        ):
            self.breach(why[0], f"a fast motion stays in force, and {why[1]}")

    def ended(self) -> None:
        if self.live and self.passing < 0.95 * self.sent:
            self.breach("live", f"of {self.sent} commands in automatic mode {self.passing} pass")
