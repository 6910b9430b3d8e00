"""`/v1/audit/summary`: the denials by host. A summary may read much of the log, so only one is made at a time."""

import asyncio
from pathlib import Path
from typing import Annotated

from fastapi import Query

from appliance.api.front.moments import given
from appliance.api.front.problems import ProblemError
from appliance.api.front.route_roles import Viewer
from appliance.api.front.routing import Routes
from appliance.api.front.streams import Work
from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.search.denial_summary import LARGEST_SUMMARY, DenialSummary, summary_of_log
from appliance.audit.search.query import Filter


def add_summary(router: Routes, audit_log: Path) -> None:
    one = Work("summaries of the audit log", 1)

    @router.get("/summary")
    async def summarise_audit(
        bearer: Viewer,
        since: Annotated[
            str | None, Query(max_length=64, description="1h (ago), a date, or RFC 3339")
        ] = None,
        until: Annotated[str | None, Query(max_length=64, description="before this time")] = None,
        limit: Annotated[int, Query(ge=1, le=LARGEST_SUMMARY, description="largest number of hosts")] = 20,
    ) -> DenialSummary:
        """The denials of each host: number, first and last time, most frequent rules or reasons, and callers."""
        begin, end = (None if time is None else given(time) for time in (since, until))
        async with one.turn(bearer):
            try:
                return await asyncio.to_thread(
                    summary_of_log, audit_log, Filter(since=begin, until=end), limit
                )
            except LogUnreadableError as error:
                raise ProblemError(503, "log-unreadable", str(error)) from error
