"""Keep the slot of a process in the table of processes, and compute the delay of its restarts."""

import asyncio
import os
from dataclasses import dataclass, field

import msgspec

from appliance.base import clock
from appliance.supervisor.child_entry import LaunchPlan
from appliance.supervisor.process_handle import ProcessHandle, program_environment
from appliance.supervisor.role import Facts, Role
from appliance.supervisor.sandbox.folders import with_system_files
from appliance.supervisor.users import account_of

FAILING_AFTER = 5  # short runs in a row
_BACKOFF = (0.0, 0.2, 0.5, 1.0)
_LONGEST_DELAY = 60.0  # seconds, for dispensable roles
STABLE_SECONDS = 10.0


@dataclass
class ProcessSlot:
    """The running process of a role, or its next start."""

    role: Role
    index: int
    process: ProcessHandle | None = None
    starts: int = 0
    short_runs: int = 0  # number of short runs in a row
    due: asyncio.TimerHandle | None = None
    wanted: bool = False  # for a role on demand: requested again since its last start
    dismissed: bool = False  # for a role on demand: killed, because control asked for its end
    pardoned: bool = False  # the supervisor ends this process because the appliance is not active any more
    since: clock.Began = field(default_factory=clock.Began)  # the last start
    reason: str = ""  # why the last run ended, in the process's own words if it sent any
    output: tuple[str, ...] = ()  # the last output lines of its program

    @property
    def is_free(self) -> bool:
        return self.process is None and self.due is None

    @property
    def is_starting(self) -> bool:
        if self.role.on_demand or self.role.dispensable:
            return False
        return self.process is None or not (self.process.ready or self.process.is_program)

    @property
    def is_failing(self) -> bool:
        """Whether the last runs were all short, so operators must be notified."""
        return self.short_runs >= FAILING_AFTER

    @property
    def is_late(self) -> bool:
        role = self.role
        waited_for = (
            role.program is None and role.after is None and not role.on_demand and not role.dispensable
        )
        return waited_for and (self.process is None or not self.process.ready)

    def record_death(self, process: ProcessHandle) -> float:
        self.process = None
        self.since = process.since
        lived = clock.now() - process.started
        self.short_runs = self.short_runs + 1 if lived < STABLE_SECONDS and not self.pardoned else 0
        return lived

    def recovers(self) -> bool:
        lasts = self.process is not None and clock.now() - self.process.started >= STABLE_SECONDS
        if not (lasts and self.is_failing):
            return False
        self.short_runs, self.reason, self.output = 0, "", ()
        return True

    def delay(self) -> float:
        if self.is_failing and self.role.dispensable:
            return min(2.0 ** (self.short_runs - FAILING_AFTER + 1), _LONGEST_DELAY)
        return _BACKOFF[min(max(self.short_runs - 1, 0), len(_BACKOFF) - 1)]

    def plan(self, facts: Facts, lifeline: int, lender: int | None) -> LaunchPlan:
        role = self.role
        home = str(facts.part(role.part))
        plan = LaunchPlan(
            parent=os.getpid(),
            lifeline=lifeline,
            lender=lender,
            view=facts.view,
            account=account_of(role.user, group=role.group),
            home=home,
            network=role.network,
            files=role.files,
            sandbox=with_system_files(role.sandbox(facts), home, str(facts.config.parent)),
            entry=role.entry,
            index=self.index if role.indexed else None,
            path=str(role.path(facts)) if role.path else None,
            capabilities=role.capabilities,
            ended_early=role.ended_early,
            nice=role.nice + facts.raised,
            slice_ns=role.slice_ns,
            takes_secret=role.secret is not None,
            secret=str(secret) if role.secret is not None and (secret := role.secret(facts)) else None,
        )
        if role.program is None:
            return plan
        program = role.program(facts)
        return msgspec.structs.replace(
            plan, argv=program.argv, environment=program_environment(home, dict(program.environment))
        )
