"""Worlds of `estop`: stop buttons and resets of several nodes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from lab.closed_loop.messages import STILL, VELOCITIES, Legs, boolean, straight
from lab.closed_loop.world import NEVER, SLACK, World


@dataclass
class Button:
    """The last message of a node on the topic of a stop or of a reset."""

    on: bool = False
    heard: int = NEVER


class EstopWorld(World):
    """Stop buttons and resets of several nodes: stop, manual reset, two hands."""

    preset: ClassVar[str] = "estop"
    not_yet: ClassVar[Mapping[str, str]] = {
        "a press while it is disabled": "it is not known until the button sends again"
    }
    span = 8000

    def plan(self) -> None:
        r = self.random
        self.kind = r.choice(VELOCITIES)
        self.hands = r.random() < 0.4
        self.silent = r.choice((0.0, 0.3, 1.0))
        self.stops: dict[int, Button] = {}
        self.resets: dict[int, Button] = {}
        self.edges: dict[int, int] = {}
        self.needs_reset = False
        self.latched_at = NEVER
        self.latched_by = "L6"
        self.doubtful = ""
        """The law that a motion breaks until the guard is resumed."""
        self.reset_at = NEVER
        self.waiting: set[int] = set()
        """Nodes whose next command must stand still."""
        self.live = r.random() < 0.15
        self.publishers = self.seed % (2 if self.live else 3)
        self.together, self.zero_first = r.choice((0.3, 0.5, 2.0)), r.random() < 0.8
        self.guard_with({
            "twoHands": self.hands, "silent": self.silent, "publishers": self.publishers, "together": self.together,
            "zeroFirst": self.zero_first, "forget": r.choice((0, 7)),
        })  # fmt: skip
        for node in (1, 2) if r.random() < 0.5 else (1,):
            self._drives(node)
        buttons = (3,) if self.live else r.choice(((3,), (3, 4), (3, 4)))
        for node in buttons:
            self._button(node)
        if self.live:
            self._honest()
            return
        for node in (5, 6) if self.hands or r.random() < 0.5 else (5,):
            self._resets(node)
        self.interrupt(0.4)
        if r.random() < 0.15:
            self.after(r.uniform(1500, 6000), self._forget)

    def _drives(self, node: int) -> None:
        r = self.random
        period = r.choice((20, 50, 100))
        stubborn = not self.live and r.random() < 0.3

        def send() -> None:
            pause = self.now < 300 or (self.live and 4500 < self.now < 5500)
            self.drive(
                STILL if pause or (not stubborn and not self.live and r.random() < 0.05) else straight(0.5),
                node,
            )

        self.every(lambda: period * r.uniform(0.8, 1.2), send, first=r.uniform(0, 100))

    def _forget(self) -> None:
        self.trace("the guard is told to forget all nodes")
        self.guard.give("forget", 3)
        if not self.switched_off:
            self.stops.clear()
            self.resets.clear()
            self._latch()

    def _press(self, node: int, on: bool) -> None:
        if not self.switched_off:
            button = self.stops.setdefault(node, Button())
            button.on, button.heard = on, self.now
            if on:
                self._latch()
        self.say("stop", boolean(on), node)
        if on and not self.switched_off and self.moves(self.force[1]):
            self.breach("L3", "a press does not stop the base at once")

    def _latch(self) -> None:
        """Note a stop that only a reset ends."""
        self.needs_reset, self.latched_at = True, self.now
        self.latched_by = "L4" if self.hands or len(self.resets) > 1 else "L6"
        self.edges.clear()

    def _button(self, node: int) -> None:
        r = self.random
        changes = (
            [] if self.live else sorted(r.uniform(1600, 7000) for _change in range(r.choice((0, 2, 2, 3, 4))))
        )
        on = False

        def change(to: bool) -> None:
            nonlocal on
            on = to
            self._press(node, on)

        for number, at in enumerate(changes):
            self.after(at, lambda to=number % 2 == 0: change(to))  # type: ignore[misc]  # bound now
        dies = self.span + 1 if self.live or r.random() < 0.7 else r.uniform(500, 7000)
        begins = 1 if self.live or r.random() < 0.7 else r.uniform(100, 1500)
        self.after(begins, lambda: self._press(node, False))
        if self.silent or r.random() < 0.5:
            period = (self.silent or 0.5) * 400

            def repeat() -> None:
                self._press(node, on)

            self.every(
                lambda: -1 if self.now > dies else period * r.uniform(0.5, 1), repeat, first=begins + 2
            )

    def _reset(self, node: int, on: bool) -> None:
        button = self.resets.setdefault(node, Button())
        edge = on and not button.on and button.heard != NEVER
        if not self.switched_off:
            button.on, button.heard = on, self.now
        if edge and self.needs_reset and not self._pressed() and not self.switched_off:
            self.edges[node] = self.now
            hands = [one for one, at in self.edges.items() if self.now - at <= self.together * 1000 + 1]
            if len(hands) >= (2 if self.hands else 1):
                self.needs_reset, self.reset_at = False, self.now
                self.waiting = {1, 2}
                self.edges.clear()
        self.say("reset", boolean(on), node)

    def _pressed(self) -> bool:
        return any(button.on for button in self.stops.values())

    def _resets(self, node: int) -> None:
        r = self.random
        habit = r.choice(("edges", "edges", "stuck", "tied", "idle"))

        def act() -> None:
            match habit:
                case "edges":
                    self._reset(node, False)
                    self.after(self.now + r.uniform(5, 250), lambda: self._reset(node, True))
                    self.after(self.now + r.uniform(251, 400), lambda: self._reset(node, False))
                case "stuck":
                    self._reset(node, True)
                case "tied":
                    self._reset(node, self.now > 300)
                case "idle":
                    self._reset(node, False)

        self.every(lambda: r.choice((100, 500, 1500)), act, first=r.uniform(0, 1000))

    def _honest(self) -> None:
        """Plan a press, a release, resets by two nodes, a stop command, and motion."""
        self.after(2000, lambda: self._press(3, True))
        self.after(2500, lambda: self._press(3, False))
        for node in (5, 6):
            for at, on in ((3000, False), (3500 + 10 * node, True), (3900, False)):
                self.after(at, lambda node=node, on=on: self._reset(node, on))  # type: ignore[misc]  # bound now

    def lost(self) -> None:
        self.trace("the process is replaced, and its state is lost")
        self.guard.restart(self.now, lost=True)
        self._doubt("L5")

    def cut(self) -> None:
        self.trace("a button sends bytes that are no message")
        self.say("stop", b"", 3, whole=False)
        self._doubt("L2")

    def _doubt(self, law: str) -> None:
        self.doubtful, self.fresh_from = law, self.now
        self.after(self.now + self.random.choice((50, 300, 1000)), self.resume_guard)

    def resume_guard(self) -> None:
        """Resume the guard: the act of a person, after which each node stands still before it moves."""
        lost_at = self.fresh_from
        super().resume_guard()
        if self.doubtful == "L5":  # nothing is known of a button that has said nothing since
            self.stops = {node: button for node, button in self.stops.items() if button.heard >= lost_at}
            self.needs_reset = self._pressed()
        self.doubtful = ""
        self.waiting = {1, 2}

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        if not self.moves(wanted) and not self.needs_reset:
            self.waiting.discard(node)
        if got is not None and self.moves(got):
            self._may_move(node)

    def _may_move(self, node: int) -> None:
        if self.doubtful:
            self.breach(self.doubtful, "a motion passes before a person has resumed the guard")
        pressed = [one for one, button in self.stops.items() if button.on]
        if pressed:
            self.breach(
                "L4" if len(self.stops) > 1 else "L3",
                f"a motion passes while node {pressed[0]} presses the stop",
            )
        if self.needs_reset:
            self.breach(
                self.latched_by, f"a motion passes without a reset after the stop at {self.latched_at} ms"
            )
        if node in self.waiting and self.zero_first:
            self.breach(
                "L6",
                f"node {node} has not stood still since the reset at {self.reset_at} ms, or a resume",
            )
        heard = sum(button.heard != NEVER for button in self.stops.values())
        if heard < max(self.publishers, 1):
            self.breach("L2", f"a motion passes when {heard} of {self.publishers} buttons have spoken")
        for one, button in self.stops.items():
            if self.silent and self.now > button.heard + self.silent * 1000 + 100 + SLACK:
                self.breach(
                    "L4", f"a motion passes while the button of node {one} is silent since {button.heard} ms"
                )

    def watch(self) -> None:
        self.only_fresh()
        if self.switched_off or not self.moves(self.force[1]):
            return
        for one, button in self.stops.items():
            if self.silent and self.now > button.heard + self.silent * 1000 + 100 + SLACK:
                self.breach("L4", f"a motion stays in force while the button of node {one} is silent")

    def ended(self) -> None:
        if self.live and not self.moves(self.force[1]):
            self.breach("live", "after a release, a reset and a stop command a motion does not pass")
