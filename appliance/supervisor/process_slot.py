"""A place in the table of processes that is to be filled at all times, and how long it stays empty after a death."""

import asyncio
import os
import time
from dataclasses import dataclass

import msgspec

from appliance.supervisor.child_entry import Plan
from appliance.supervisor.process_handle import Life, program_environment
from appliance.supervisor.roles import Facts, Role
from appliance.supervisor.sandbox.folders import furnished
from appliance.supervisor.users import account_of

LOUD_AFTER = 5  # short lives in a row
_BACKOFF = (0.0, 0.2, 0.5, 1.0)
_LONGEST_DELAY = 60.0  # of what the others go on without
LONG_LIFE_SECONDS = 10.0


@dataclass
class Post:
    """A role, or one of several of it, and who fills it now."""

    role: Role
    index: int
    life: Life | None = None
    lives: int = 0
    short_lives: int = 0  # in a row
    due: asyncio.TimerHandle | None = None
    wanted: bool = False  # of a role on demand: asked for since this life began
    since: str = ""  # when its last life began
    reason: str = ""  # why its last life ended: in its own words, if it had any
    output: tuple[str, ...] = ()  # the last lines of what it ran

    @property
    def is_vacant(self) -> bool:
        """Nobody fills it, and nobody is about to."""
        return self.life is None and self.due is None

    @property
    def keeps_dying(self) -> bool:
        """Its last lives were short, so many that somebody must be told."""
        return self.short_lives >= LOUD_AFTER

    @property
    def is_late(self) -> bool:
        """Nodes cannot connect before it is ready, and it is not."""
        role = self.role
        waited_for = (
            role.program is None and role.after is None and not role.on_demand and not role.dispensable
        )
        return waited_for and (self.life is None or not self.life.ready)

    def bury(self, life: Life) -> float:
        """Note the death of who filled it; the seconds that it lived."""
        self.life = None
        self.since = life.since
        lived = time.monotonic() - life.started
        self.short_lives = self.short_lives + 1 if lived < LONG_LIFE_SECONDS else 0
        return lived

    def recovers(self) -> bool:
        """Forget that its lives kept ending when this one has lasted; whether that is so now."""
        lasts = self.life is not None and time.monotonic() - self.life.started >= LONG_LIFE_SECONDS
        if not (lasts and self.keeps_dying):
            return False
        self.short_lives, self.reason, self.output = 0, "", ()
        return True

    def delay(self) -> float:
        """Return the seconds until it is to be filled again: none after a long life, more after each short one."""
        if self.keeps_dying and self.role.dispensable:
            return min(2.0 ** (self.short_lives - LOUD_AFTER + 1), _LONGEST_DELAY)
        return _BACKOFF[min(max(self.short_lives - 1, 0), len(_BACKOFF) - 1)]

    def plan(self, facts: Facts, lifeline: int) -> Plan:
        """How its next life is to be started; `lifeline` is the child's end."""
        role = self.role
        home = str(facts.part(role.part))
        plan = Plan(
            parent=os.getpid(),
            lifeline=lifeline,
            account=account_of(role.user, group=role.group),
            home=home,
            network=role.network,
            files=role.files,
            walls=furnished(role.walls(facts), home, str(facts.config.parent)),
            entry=role.entry,
            index=self.index if role.indexed else None,
            path=str(role.path(facts)) if role.path else None,
            capabilities=role.capabilities,
            ended_early=role.ended_early,
            takes_secret=role.secret is not None,
            secret=str(secret) if role.secret is not None and (secret := role.secret(facts)) else None,
        )
        if role.program is None:
            return plan
        program = role.program(facts)
        return msgspec.structs.replace(
            plan, argv=program.argv, environment=program_environment(home, dict(program.environment))
        )
