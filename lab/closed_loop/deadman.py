"""Worlds of `deadman`: nodes that drive over links that break."""

import math
from dataclasses import dataclass
from typing import ClassVar

from lab.closed_loop.messages import STILL, VELOCITIES, Legs, straight
from lab.closed_loop.world import NEVER, SLACK, World


@dataclass
class Driver:
    """A node that commands motions, and what has reached the guard."""

    node: int
    heard: int = NEVER
    wants_motion: bool = False
    got_at: int = NEVER
    """When the base last got a motion of this node."""
    stopped_at: int = NEVER
    broke_at: int = NEVER
    """When a message came after a silence."""


class DeadmanWorld(World):
    """One or two nodes drive over links that break, and deliver late what they held."""

    preset: ClassVar[str] = "deadman"

    def plan(self) -> None:
        r = self.random
        self.kind = r.choice(VELOCITIES)
        self.silent = round(r.uniform(0.1, 1), 2)
        self.resume = r.choice((0.2, 0.2, 0.45))
        self.guard_with({"silent": self.silent, "resume": self.resume})
        self.live = r.random() < 0.15
        self.sent = self.got = 0
        self.drivers = {node: Driver(node) for node in range(1, 2 if self.live else r.choice((2, 3)))}
        for driver in self.drivers.values():
            self._streams(driver)
        if not self.live:
            self.interrupt(0.35)

    def _streams(self, driver: Driver) -> None:
        r = self.random
        period = r.uniform(20, min(self.silent * 850, 300))
        cut_from, cut_until = float(self.span), 0.0
        if not self.live:
            cut_from = r.uniform(500, 6000)
            cut_until = cut_from + r.choice(
                (self.silent * 1000 + r.uniform(60, 2500), r.uniform(10, 500), self.span)
            )
        held: list[tuple[Legs, int]] = []
        holds, ends = r.random() < 0.7, r.random() < 0.5
        legs = straight(0.5, 0.1)

        def send() -> None:
            nonlocal legs
            if not self.live and r.random() < 0.05:
                legs = r.choice(
                    (STILL, straight(0.7), straight(0.0, 0.4), straight(-0.3), straight(math.nan))
                )
            if cut_from <= self.now < cut_until:
                held.append((legs, self.now))
                return
            if cut_until <= self.now and ends and cut_until:
                return
            self.drive(legs, driver.node)

        def deliver() -> None:
            for legs, made in held[-40:] if holds else ():
                self.drive(legs, driver.node, made)
            held.clear()

        self.every(lambda: period * r.uniform(0.8, 1.1), send, first=r.uniform(0, 400))
        if cut_until < self.span and cut_until:
            self.after(cut_until, deliver)

    def passed(self, node: int, wanted: Legs, got: "Legs | None") -> None:
        driver = self.drivers[node]
        if driver.heard != NEVER and self.now - driver.heard > self.silent * 1000 + SLACK:
            driver.broke_at = self.now
        driver.heard, driver.wants_motion = self.now, self.moves(wanted)
        late = (self.now - self.made) / 1000
        if got is not None and self.moves(got):
            driver.got_at = self.now
            if self.now < driver.broke_at + self.resume * 1000 - SLACK:
                self.breach("L6", f"a motion passes {self.now - driver.broke_at} ms after a silence")
            if late > self.silent + SLACK / 1000 and driver.broke_at >= self.now - 10:
                self.breach("L6", f"a motion passes that comes {late:.2f} s late, after a silence")
            self.got += self.now > 1500
        self.sent += self.now > 1500

    def received(self, at: int, legs: Legs) -> None:
        super().received(at, legs)
        if not self.moves(legs):
            for driver in self.drivers.values():
                driver.stopped_at = at

    def watch(self) -> None:
        self.only_fresh()
        if self.switched_off or self.guard.holds:
            return
        limit = self.silent * 1000 + SLACK
        for driver in self.drivers.values():
            is_silent = self.now > max(driver.got_at, driver.heard) + limit
            if driver.wants_motion and is_silent and driver.got_at > max(driver.stopped_at, self.fresh_from):
                law = "L4" if len(self.drivers) > 1 and self.force[0] > driver.heard else "L3"
                self.breach(
                    law, f"node {driver.node} is silent since {driver.heard} ms, and no stop has come"
                )

    def ended(self) -> None:
        if self.live and self.got < 0.9 * self.sent:
            self.breach("live", f"of {self.sent} commands of a node that is never silent {self.got} pass")
