"""`/v1/monitors`: load, replace and remove specifications; switch and resume monitors.

Loading and removing is for admins, switching and going back to the folder for operators. Every change needs
`If-Match` with the ETag of `GET /v1/monitors`; a text with an error changes nothing.
"""

from typing import Annotated

from fastapi import Query
from msgspec.structs import asdict
from pydantic import StringConstraints

from appliance.api.access import Bearer
from appliance.api.control import ControlLink
from appliance.api.monitor_judgement import findings_of, refusal
from appliance.api.monitor_models import NewSpecifications, NewText, Replaced, Switch, SwitchMany
from appliance.api.monitor_routes import UNKNOWN, OneName, unknown_monitor
from appliance.api.policy_changes import Confirm, DryRun
from appliance.api.policy_models import Rollback
from appliance.api.preconditions import IfMatch, etag, expected_tag
from appliance.api.problems import ProblemError
from appliance.api.route_roles import Admin, Operator, answered, ask, problem_of
from appliance.api.routing import ETAG, Responses, Routes, Tagged, body, tagged
from appliance.api.services import Services
from appliance.channel import admin
from appliance.channel.admin import A, AdminRequest
from appliance.channel.answers import monitor_answers as answers
from appliance.channel.answers.monitor_answers import MonitorsConfirmed, Switched
from appliance.channel.answers.token_answers import may

_COMPILE_SECONDS = 40.0  # of RVMaster and then of the relay
Prune = Annotated[bool, Query(description="also remove what the folder does not have")]
Force = Annotated[bool, Query(description="also where that cuts a topic whose publisher has another type")]
Shadow = Annotated[bool, Query(description="the specifications come into force in shadow mode")]
_CHANGES: Responses = {
    412: {
        "description": "The monitors were changed, switched or resumed since they had the ETag of If-Match.",
        "headers": ETAG,
    },
    428: {"description": "If-Match is missing."},
}


def routes(services: Services) -> Routes:
    """The routes."""
    router = Routes(prefix="/v1/monitors", tags=["monitors"])
    _add_texts(router, services.control)
    _add_revisions(router, services.control)
    _add_removals(router, services.control)
    _add_switches(router, services.control)
    return router


def _add_texts(router: Routes, control: ControlLink) -> None:
    @router.post("", responses=_CHANGES)
    async def load_monitors(
        new: Annotated[NewSpecifications, body(NewSpecifications)],
        bearer: Operator,
        *,
        if_match: IfMatch = None,
        dry_run: DryRun = False,
        confirm_within: Confirm = None,
        force: Force = False,
        shadow: Shadow = False,
    ) -> Tagged[Replaced]:
        """Compile and load specifications; those in files of the same name are replaced, in one swap. For admins.

        A text with an error changes nothing: the answer (422) has every finding with its line and column.
        """
        _may_load(bearer, dry_run=dry_run)
        expected = _expected(if_match, dry_run=dry_run)
        if dry_run:
            tried = admin.MonitorTry(new.files, new.definitions, new.signatures, expected, force, shadow)
            return await _tried(control, tried, bearer)
        order = admin.MonitorLoad(
            **asdict(new), expected=expected, confirm_within=confirm_within, force=force, shadow=shadow
        )
        return await _replaced(control, order, bearer)

    @router.put("/{name}", responses=_CHANGES | UNKNOWN)
    async def replace_monitor(
        *,
        name: OneName,
        new: Annotated[NewText, body(NewText, text="the specification")],
        bearer: Operator,
        if_match: IfMatch = None,
        dry_run: DryRun = False,
        confirm_within: Confirm = None,
        force: Force = False,
        shadow: Shadow = False,
    ) -> Tagged[Replaced]:
        """Load a new text in the place of the file that this monitor stands in (or of the file of this name).

        For admins; a dry run for operators, too.
        """
        _may_load(bearer, dry_run=dry_run)
        expected = _expected(if_match, dry_run=dry_run)
        if not dry_run:
            order = admin.MonitorReplace(
                name=name,
                **asdict(new),
                expected=expected,
                confirm_within=confirm_within,
                force=force,
                shadow=shadow,
            )
            return await _replaced(control, order, bearer)
        file = await _file_of(control, name, bearer)
        signatures = {**new.signatures, file: new.signature}
        tried = admin.MonitorTry({file: new.text}, new.definitions, signatures, expected, force, shadow)
        return await _tried(control, tried, bearer)


def _add_revisions(router: Routes, control: ControlLink) -> None:
    """What the folder has, and what was in force before."""

    @router.post("/reload", responses=_CHANGES)
    async def reload_monitors(
        bearer: Operator,
        *,
        if_match: IfMatch = None,
        prune: Prune = False,
        confirm_within: Confirm = None,
        force: Force = False,
        shadow: Shadow = False,
    ) -> Tagged[Replaced]:
        """Take what the folder has now; what it does not have stays, unless an admin says `prune`."""
        if prune and not may(bearer.role, "admin"):
            raise problem_of("forbidden", "removing what the folder does not have is for admins")
        order = admin.MonitorReload(_expected(if_match), prune, confirm_within, force, shadow)
        return await _replaced(control, order, bearer)

    @router.post("/rollback", responses=_CHANGES)
    async def roll_back_monitors(
        to: Annotated[Rollback, body(Rollback)], bearer: Admin, if_match: IfMatch = None
    ) -> Tagged[Replaced]:
        """Bring a kept revision into force again, as a new one; what comes back is switched as it was."""
        return await _replaced(control, admin.MonitorRollback(to.revision, _expected(if_match)), bearer)

    @router.post("/confirm", responses=_CHANGES)
    async def confirm_monitors(bearer: Operator, if_match: IfMatch = None) -> Tagged[MonitorsConfirmed]:
        """Keep specifications that were loaded with `confirm_within`."""
        return tagged(await _ordered(control, admin.MonitorConfirm(_expected(if_match)), bearer))


def _add_removals(router: Routes, control: ControlLink) -> None:
    @router.delete("/{name}", responses=_CHANGES | UNKNOWN)
    async def remove_monitor(
        name: OneName, bearer: Admin, if_match: IfMatch = None, confirm_within: Confirm = None
    ) -> Tagged[Replaced]:
        """Remove the file of a monitor (or the file of this name); refused where others use its variables."""
        order = admin.MonitorRemove([name], _expected(if_match), confirm_within)
        return await _replaced(control, order, bearer)

    @router.delete("", responses=_CHANGES | UNKNOWN)
    async def remove_monitors(
        name: Annotated[
            list[Annotated[str, StringConstraints(min_length=1, max_length=256)]],
            Query(min_length=1, max_length=1000),
        ],
        bearer: Admin,
        if_match: IfMatch = None,
        confirm_within: Confirm = None,
    ) -> Tagged[Replaced]:
        """The same for several at once."""
        order = admin.MonitorRemove(name, _expected(if_match), confirm_within)
        return await _replaced(control, order, bearer)


def _add_switches(router: Routes, control: ControlLink) -> None:
    @router.patch("/{name}", responses=_CHANGES | UNKNOWN)
    async def switch_monitor(
        *,
        name: OneName,
        to: Annotated[Switch, body(Switch)],
        bearer: Operator,
        if_match: IfMatch = None,
        force: Force = False,
    ) -> Tagged[Switched]:
        """Enable or disable a monitor, put it into shadow mode (`{"shadow": true}`) or from there into force (`false`).

        `{"enabled": false, "for_seconds": 600}` disables it for ten minutes. `{"held": false}` lets the topics that it
        holds go on.
        """
        return await _switched(control, [name], to, _expected(if_match), bearer, force=force)

    @router.patch("", responses=_CHANGES | UNKNOWN)
    async def switch_monitors(
        *,
        to: Annotated[SwitchMany, body(SwitchMany)],
        bearer: Operator,
        if_match: IfMatch = None,
        force: Force = False,
    ) -> Tagged[Switched]:
        """The same for several at once."""
        return await _switched(control, to.names, to, _expected(if_match), bearer, force=force)


async def _tried(control: ControlLink, order: admin.MonitorTry, bearer: Bearer) -> Tagged[Replaced]:
    """Answer a dry run; control and the compiler say how many there may be."""
    done = await _ordered(control, order, bearer)
    return tagged(Replaced(**asdict(done) | {"warnings": findings_of(done.warnings)}, loaded=False))


async def _replaced(
    control: ControlLink, order: AdminRequest[answers.Replaced], bearer: Bearer
) -> Tagged[Replaced]:
    done = await _ordered(control, order, bearer)
    rows = (await ask(control, admin.MonitorsWanted(), bearer)).monitors
    fields = asdict(done) | {"warnings": findings_of(done.warnings)}
    return tagged(Replaced(**fields, loaded=True, monitors=[row.name for row in rows]))


async def _switched(
    control: ControlLink, names: list[str], to: Switch, expected: str | None, bearer: Bearer, *, force: bool
) -> Tagged[Switched]:
    order: AdminRequest[Switched] = admin.MonitorResume(names, expected)
    if to.enabled is not None:
        order = admin.MonitorSwitch(names, to.enabled, expected, to.for_seconds)
    elif to.shadow is not None:
        order = admin.MonitorShadow(names, to.shadow, expected, force)
    elif to.trial is not None:
        order = admin.MonitorTrial(names, to.trial, expected)
    return tagged(await _ordered(control, order, bearer))


async def _file_of(control: ControlLink, name: str, bearer: Bearer) -> str:
    """The file that a monitor stands in. Raises `ProblemError` (404)."""
    loaded = await ask(control, admin.MonitorsWanted(texts=True), bearer)
    files = {row.name: row.file for row in loaded.monitors}
    if name in (loaded.files or {}):
        return name
    if name not in files:
        raise unknown_monitor(name, loaded)
    return files[name]


async def _ordered(control: ControlLink, order: AdminRequest[A], bearer: Bearer) -> A:
    done = await control.ask(order, bearer, _COMPILE_SECONDS)
    if not done.ok and done.trouble == "refused":
        raise refusal(done.error, done.findings)
    if not done.ok and done.trouble == "conflict":
        raise _stale(done.error, done.tag)
    return answered(done)


def _stale(text: str, tag: str) -> ProblemError:
    """Somebody else was quicker; the present ETag is in the answer."""
    return ProblemError(412, "changed-meanwhile", text, headers={"ETag": etag(tag)})


def _may_load(bearer: Bearer, *, dry_run: bool) -> None:
    if not dry_run and not may(bearer.role, "admin"):
        raise problem_of("forbidden", "loading specifications is for admins; operators may use dry_run=1")


def _expected(if_match: str | None, *, dry_run: bool = False) -> str | None:
    if dry_run and if_match is None:
        return None
    return expected_tag(if_match, "monitors", "/v1/monitors")
