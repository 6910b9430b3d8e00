"""`/v1/monitors`: load, replace and remove specifications; switch and resume monitors.

Loading and removing is for admins, switching and going back to the folder for operators. Every change needs
`If-Match` with the ETag of `GET /v1/monitors`; a text with an error changes nothing.
"""

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from appliance.api.access import Bearer, Role
from appliance.api.bodies import WRONG_TYPE, DryRun, read_body, text_or
from appliance.api.control import ControlLink
from appliance.api.monitor_judgement import Draft, findings_of, judge, refusal
from appliance.api.monitor_models import (
    Name,
    NewSpecifications,
    NewText,
    Replaced,
    Switch,
    Switched,
    SwitchMany,
)
from appliance.api.monitors import TAGGED, UNKNOWN, OneName
from appliance.api.preconditions import IfMatch, etag, expected_tag
from appliance.api.problems import ProblemError
from appliance.api.roles import Admin, Operator, answered, ask
from appliance.api.services import Services
from appliance.channel.admin import (
    MonitorChange,
    MonitorLoad,
    MonitorReload,
    MonitorRemove,
    MonitorReplace,
    MonitorResume,
    MonitorsWanted,
    MonitorSwitch,
)

_COMPILE_SECONDS = 40.0  # of RVMaster and then of the relay
Prune = Annotated[bool, Query(description="also remove what the folder does not have")]
_CHANGES: dict[int | str, dict[str, Any]] = {
    **TAGGED,
    412: {
        "description": "The monitors were changed, switched or resumed since they had the ETag of If-Match.",
        "headers": TAGGED[200]["headers"],
    },
    428: {"description": "If-Match is missing."},
}


def routes(services: Services) -> APIRouter:
    """The routes."""
    router = APIRouter(prefix="/v1/monitors", tags=["monitors"])
    changing = _Changing(services)
    _add_texts(router, changing)
    _add_switches(router, changing)
    return router


def _add_texts(router: APIRouter, changing: "_Changing") -> None:
    @router.post("", operation_id="load_monitors", responses=_CHANGES)
    async def load_monitors(
        new: NewSpecifications,
        bearer: Operator,
        response: Response,
        if_match: IfMatch = None,
        dry_run: DryRun = False,
    ) -> Replaced:
        """Compile and load specifications; those in files of the same name are replaced, in one swap. For admins.

        A text with an error changes nothing: the answer (422) has every finding with its line and column.
        """
        _may_load(bearer, dry_run=dry_run)
        order = MonitorLoad(new.files, new.definitions, new.note, _expected(if_match, dry_run=dry_run))
        return await changing.load(order, bearer, response, dry_run=dry_run)

    @router.put(
        "/{name}",
        operation_id="replace_monitor",
        responses=_CHANGES | UNKNOWN | WRONG_TYPE,
        openapi_extra=text_or(NewText),
    )
    async def replace_monitor(
        *,
        name: OneName,
        request: Request,
        bearer: Operator,
        response: Response,
        if_match: IfMatch = None,
        dry_run: DryRun = False,
    ) -> Replaced:
        """Load a new text in the place of the file that this monitor stands in (or of the file of this name).

        For admins; a dry run for operators, too.
        """
        _may_load(bearer, dry_run=dry_run)
        content_type = request.headers.get("content-type", "")
        new = read_body(content_type, await request.body(), NewText, "the specification")
        expected = _expected(if_match, dry_run=dry_run)
        if not dry_run:
            replacing = MonitorReplace(name, new.text, new.definitions, new.note, expected)
            return await changing.replace(replacing, bearer, response)
        file = await changing.file_of(name, bearer)
        order = MonitorLoad({file: new.text}, new.definitions, new.note, expected)
        return await changing.load(order, bearer, response, dry_run=True)

    @router.post("/reload", operation_id="reload_monitors", responses=_CHANGES)
    async def reload_monitors(
        bearer: Operator, response: Response, if_match: IfMatch = None, prune: Prune = False
    ) -> Replaced:
        """Take what the folder has now; what was loaded from elsewhere stays, unless an admin says `prune`."""
        if prune and bearer.role < Role.ADMIN:
            raise ProblemError(
                403, "not-for-this-role", "removing what was loaded from elsewhere is for admins"
            )
        return await changing.replace(MonitorReload(_expected(if_match), prune), bearer, response)

    @router.delete("/{name}", operation_id="remove_monitor", responses=_CHANGES | UNKNOWN)
    async def remove_monitor(
        name: OneName, bearer: Admin, response: Response, if_match: IfMatch = None
    ) -> Replaced:
        """Remove the file of a monitor (or the file of this name); refused where others use its variables."""
        return await changing.replace(MonitorRemove([name], _expected(if_match)), bearer, response)

    @router.delete("", operation_id="remove_monitors", responses=_CHANGES | UNKNOWN)
    async def remove_monitors(
        name: Annotated[list[Name], Query(min_length=1, max_length=1000)],
        bearer: Admin,
        response: Response,
        if_match: IfMatch = None,
    ) -> Replaced:
        """The same for several at once."""
        return await changing.replace(MonitorRemove(name, _expected(if_match)), bearer, response)


def _add_switches(router: APIRouter, changing: "_Changing") -> None:
    @router.patch("/{name}", operation_id="switch_monitor", responses=_CHANGES | UNKNOWN)
    async def switch_monitor(
        name: OneName, to: Switch, bearer: Operator, response: Response, if_match: IfMatch = None
    ) -> Switched:
        """Enable or disable a monitor, or let the topics that it holds go on (`{"held": false}`)."""
        return await changing.switch([name], to, _expected(if_match), bearer, response)

    @router.patch("", operation_id="switch_monitors", responses=_CHANGES | UNKNOWN)
    async def switch_monitors(
        to: SwitchMany, bearer: Operator, response: Response, if_match: IfMatch = None
    ) -> Switched:
        """The same for several at once."""
        return await changing.switch(to.names, to, _expected(if_match), bearer, response)


class _Changing:
    """What the routes of changes have in common."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._control = services.control

    async def load(
        self, order: MonitorLoad, bearer: Bearer, response: Response, *, dry_run: bool
    ) -> Replaced:
        if not dry_run:
            return await self.replace(order, bearer, response)
        body = await ask(self._control, MonitorsWanted(texts=True), bearer)
        if order.expected not in (None, body["tag"]):
            text = f"the monitors are at {body['tag']}, not at {order.expected}: look at them first"
            raise _stale(text, body["tag"])
        async with self._services.judging:
            draft = await asyncio.to_thread(judge, body, order.files, order.definitions, body["revision"])
        response.headers["ETag"] = etag(body["tag"])
        return _would(draft, body["revision"], body["tag"])

    async def replace(self, order: MonitorChange, bearer: Bearer, response: Response) -> Replaced:
        body = await _order(self._control, order, bearer)
        response.headers["ETag"] = etag(body["tag"])
        rows = (await ask(self._control, MonitorsWanted(), bearer))["monitors"]
        return Replaced.model_validate(
            body
            | {
                "loaded": True,
                "warnings": findings_of(body["warnings"]),
                "monitors": [row["name"] for row in rows],
            }
        )

    async def switch(
        self, names: list[str], to: Switch, expected: str | None, bearer: Bearer, response: Response
    ) -> Switched:
        order: MonitorChange = MonitorResume(names, expected)
        if to.enabled is not None:
            order = MonitorSwitch(names, to.enabled, expected)
        body = await _order(self._control, order, bearer)
        response.headers["ETag"] = etag(body["tag"])
        return Switched(revision=body["revision"], tag=body["tag"], names=body["names"])

    async def file_of(self, name: str, bearer: Bearer) -> str:
        """The file that a monitor stands in. Raises `ProblemError` (404)."""
        body = await ask(self._control, MonitorsWanted(texts=True), bearer)
        files = {row["name"]: row["file"] for row in body["monitors"]}
        if name in body["files"]:
            return name
        if name not in files:
            known = ", ".join(files) or "none is loaded"
            raise ProblemError(404, "unknown", f"no monitor is named {name}; there are: {known}")
        return str(files[name])


async def _order(control: ControlLink, order: MonitorChange, bearer: Bearer) -> dict[str, Any]:
    answer = await control.ask(order, bearer, _COMPILE_SECONDS)
    if not answer.ok and answer.trouble == "refused":
        raise refusal(answer.error, answer.findings)
    if not answer.ok and answer.trouble == "conflict":
        raise _stale(answer.error, answer.body["tag"])
    return answered(answer)


def _stale(text: str, tag: str) -> ProblemError:
    """Somebody else was quicker; the present ETag is in the answer."""
    return ProblemError(412, "changed-meanwhile", text, headers={"ETag": etag(tag)})


def _may_load(bearer: Bearer, *, dry_run: bool) -> None:
    if not dry_run and bearer.role < Role.ADMIN:
        raise ProblemError(
            403, "not-for-this-role", "loading specifications is for admins; operators may use dry_run=1"
        )


def _expected(if_match: str | None, *, dry_run: bool = False) -> str | None:
    if dry_run and if_match is None:
        return None
    return expected_tag(if_match, "monitors", "/v1/monitors")


def _would(draft: Draft, revision: int, tag: str) -> Replaced:
    return Replaced(
        loaded=False,
        revision=revision,
        tag=tag,
        replaced=None,
        added=draft.added,
        changed=draft.changed,
        removed=draft.removed,
        warnings=draft.warnings,
        monitors=draft.monitors,
    )
