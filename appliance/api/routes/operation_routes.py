"""Derive routes from the table of operations (`channel/admin.py`): parameters, role, ETag, answer, contract."""

import inspect
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any, Generic, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
from fastapi import Depends, Header, Path, Query, Request, Response
from pydantic import StringConstraints, create_model

from appliance.api.front.access import Bearer
from appliance.api.front.etags import etag
from appliance.api.front.problems import ProblemError, refusal
from appliance.api.front.recording_id import CONVERTORS
from appliance.api.front.request_gate import asked_of
from appliance.api.front.route_roles import problem_of, requires, unwrap
from appliance.api.front.routing import ETAG, Responses, Routes, Tagged, answer, body, content, with_tag
from appliance.api.front.services import Services
from appliance.channel.admin import MONITORS, A, AdminAnswer, AdminRequest, answer_to
from appliance.channel.answers.token_answers import may
from appliance.channel.messages.api import ClientRequest
from appliance.channel.operations import OPERATIONS
from appliance.channel.rest_bodies import DATE, DATED, WHOLE
from appliance.channel.rest_meaning import BadTagError, NoOrderError, order_of
from appliance.channel.rest_operation import Body, Operation, extra_of, plain, rules_of

_RULES = ("description", "examples", "gt", "ge", "lt", "le", "min_length", "max_length", "pattern")
_BODIES: dict[Body, type[msgspec.Struct]] = {}
Q_co = TypeVar("Q_co", bound=AdminRequest[object], covariant=True)


async def _if_match(
    if_match: Annotated[
        str | None,
        Header(
            alias="If-Match",
            max_length=100,
            description="The ETag of the state that the change is for, or `*` for any state.",
        ),
    ] = None,
) -> str | None:
    return if_match


async def _dry_run(
    dry_run: Annotated[
        bool, Query(description="only report the effect; for operators, without If-Match")
    ] = False,
) -> bool:
    return dry_run


async def _none() -> None:
    return None


async def _nothing() -> dict[str, object]:
    return {}


@dataclass(frozen=True)
class OperationCall(Generic[Q_co]):
    """A call of an operation; `body` is the body as sent."""

    services: Services
    operation: Operation
    bearer: Bearer
    order: Q_co
    body: Any
    dry_run: bool

    async def ask(self, request: AdminRequest[A]) -> A:
        """Return control's answer. Raises `ProblemError` for a rejection, `ControlAwayError` without an answer."""
        control = self.services.control
        return self._answered(await control.ask(request, self.bearer))

    def _answered(self, done: AdminAnswer[A]) -> A:
        if self.operation.of is MONITORS and done.trouble == "refused":
            raise refusal(done.error, done.findings)
        if done.trouble == "conflict" and done.tag:  # the present ETag is in the answer
            raise ProblemError(412, "changed-meanwhile", done.error, headers={"ETag": etag(done.tag)})
        return unwrap(done)


@dataclass(frozen=True)
class Answer:
    """A function that replaces control's answer. If it returns no struct, `success` is the answer in the contract."""

    function: Callable[[OperationCall[Any]], Awaitable[object]]
    success: Mapping[str, object] | None = None


class AnsweringRoutes(Routes):
    """Routes of a feature that also replaces control's answers, by the names of their operations."""

    def __init__(
        self, answers: Mapping[str, Answer], *, prefix: str = "", tags: list[str | Enum] | None = None
    ) -> None:
        super().__init__(prefix=prefix, tags=tags)
        self.answers = answers


def routes(services: Services, of_features: Iterable[Routes]) -> Routes:
    """Return the routes of all operations."""
    router = Routes()
    answers = {
        name: answer
        for own in of_features
        if isinstance(own, AnsweringRoutes)
        for name, answer in own.answers.items()
    }
    assert answers.keys() <= {one.name for one in OPERATIONS}  # noqa: S101  no name is misspelt
    for operation in sorted(OPERATIONS, key=lambda one: "{" in one.path):  # literal paths before parameters
        own = answers.get(operation.name)
        if is_offered(operation, own):
            _add(router, services, operation, own)
    return router


def is_offered(operation: Operation, own: Answer | None) -> bool:
    """Whether the operation is a route. Only an answer of its own tells a dry run from a load."""
    return bool(operation.name) and (own is not None or not operation.dry_run)


def _add(router: Routes, services: Services, operation: Operation, own: Answer | None) -> None:
    given = _answer_type(operation, own)
    least = "operator" if operation.dry_run else operation.role or "viewer"
    subject = _of_path(operation)
    kind = body_of(operation)
    sent = body(kind, text=operation.text or None) if kind is not None else Depends(_none)
    tag = Depends(_if_match if operation.is_change and operation.of is not None else _none)
    trial = Depends(_dry_run if operation.dry_run else _none)
    wanted = _of_query(operation)

    async def endpoint(
        *,
        request: Request,
        of_path: Annotated[dict[str, object], subject],
        of_body: Annotated[object, sent],
        bearer: Annotated[Bearer, requires(least)],
        if_match: Annotated[str | None, tag],
        dry_run: Annotated[bool | None, trial],
        of_query: Annotated[dict[str, object], wanted],
    ) -> Any:
        _check(operation, bearer, if_match, dry_run=bool(dry_run), given=of_path | of_query)
        order = _order(bearer.asked or asked_of(request.scope, request.headers, b""), dry_run=bool(dry_run))
        call = OperationCall(services, operation, bearer, order, of_body, bool(dry_run))
        if own is not None:
            return await own.function(call)
        done = await call.ask(call.order)
        if operation.status != 200:
            return answer(done, operation.status)
        return with_tag(done) if operation.of is not None else done

    has_model = given is not Response
    options: dict[str, object] = {"response_model": given} if has_model else {"response_class": Response}
    router.add_api_route(
        _convert(operation.path),
        endpoint,
        name=operation.name,
        description=inspect.cleandoc(operation.words),
        methods=[operation.method],
        tags=[operation.tag],
        status_code=operation.status,
        responses=_responses(operation, own),
        **options,
    )


def _convert(path: str) -> str:
    for name, converted in CONVERTORS.items():
        path = path.replace(name, converted)
    return path


def _check(
    operation: Operation, bearer: Bearer, if_match: str | None, *, dry_run: bool, given: Mapping[str, object]
) -> None:
    """Raise `ProblemError` if the bearer's role does not permit the operation, or `If-Match` is missing."""
    role, reason = operation.least(given, dry_run=dry_run)
    if not may(bearer.role, role):
        raise problem_of("forbidden", reason)
    if operation.is_change and operation.of is not None and if_match is None and not dry_run:
        seen = f"the ETag of the {operation.of.what} that you have seen"
        text = f"If-Match is missing: send {seen}, from GET {operation.of.where}"
        raise ProblemError(428, "precondition-required", text)


def _order(asked: ClientRequest, *, dry_run: bool) -> AdminRequest[object]:
    try:
        return order_of(asked, dry_run=dry_run)
    except BadTagError as error:
        raise ProblemError(412, "changed-meanwhile", str(error)) from None
    except NoOrderError as error:
        raise ProblemError(422, "bad-input", str(error)) from None


def _answer_type(operation: Operation, own: Answer | None) -> object:
    if own is not None:
        return get_type_hints(own.function)["return"]
    kind = answer_to(operation.request)
    if operation.status != 200:
        return Response
    return Tagged[kind] if operation.of is not None else kind  # type: ignore[valid-type]  # a type at run time


def _rules(kind: object) -> dict[str, Any]:
    """Return the rules of a parameter for FastAPI, whose patterns cannot look ahead."""
    found = {
        name: value
        for rule in rules_of(kind)
        for name in _RULES
        if (value := getattr(rule, name)) is not None
    }
    return found | ({"pattern": found["pattern"].removesuffix(WHOLE)} if "pattern" in found else {})


def body_of(operation: Operation) -> type[msgspec.Struct] | None:
    given = operation.body
    if not isinstance(given, Body):
        return given
    if given not in _BODIES:
        field: Any = msgspec.field  # it takes both defaults if one is `NODEFAULT`
        fields = [
            (one.name, _in_body(one.type), field(default=one.default, default_factory=one.default_factory))
            for one in operation.in_body()
        ]
        _BODIES[given] = msgspec.defstruct(
            given.name, fields, namespace={"__doc__": given.description}, kw_only=True, frozen=True,
            forbid_unknown_fields=True,
        )  # fmt: skip
    return _BODIES[given]


def _in_body(kind: Any) -> Any:
    """Return the type of a field in the body, which takes a date for a moment."""
    if not extra_of(kind, DATED):
        return kind
    moment, *rules = get_args(kind)
    first, *others = get_args(moment)
    return Annotated[Union[first, DATE, *others], *rules]


def _of_path(operation: Operation) -> Any:
    in_path = [(name, field) for name, field in operation.fields().items() if f"{{{name}}}" in operation.path]
    if not in_path:
        return Depends(_nothing)
    [(name, field)] = in_path
    kind: Any = get_args(plain(field.type))[0] if get_origin(plain(field.type)) is list else field.type
    rule = Path(alias=name, **_rules(kind))

    async def of_path(subject: Annotated[plain(kind), rule]) -> dict[str, object]:  # type: ignore[valid-type]  # at run time
        return {name: subject}

    return Depends(of_path)


def _of_query(operation: Operation) -> Any:
    same = [one for one in OPERATIONS if (one.method, one.path) == (operation.method, operation.path)]
    fields: dict[str, Any] = {
        name: (_in_query(field.type), ... if field.required else field.default)
        for one in same
        for wanted in one.query
        for name, field in one.fields().items()
        if field.name == wanted
    }
    if not fields:
        return Depends(_nothing)
    model: Any = create_model(operation.name, **fields)

    async def of_query(query: Annotated[model, Query()]) -> dict[str, object]:
        return dict(query)

    return Depends(of_query)


def _in_query(kind: Any) -> Any:
    base = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    if get_origin(base) is list:
        (element,) = get_args(base)
        bounds = {
            name: rule for name, rule in _rules(element).items() if name in ("min_length", "max_length")
        }
        base = list[Annotated[plain(element), StringConstraints(**bounds)]]  # type: ignore[misc]  # a type at run time
    return Annotated[base, Query(**_rules(kind))]


def _responses(operation: Operation, own: Answer | None) -> Responses:
    found: Responses = {status: {"description": text} for status, text in operation.problems.items()}
    if operation.is_change and operation.of is not None:
        found[412] = {
            "description": operation.of.changed,
            **({"headers": ETAG} if operation.of is MONITORS else {}),
        }
        found[428] = {"description": "If-Match is missing."}
    if own is not None and own.success is not None:
        found[operation.status] = {"description": operation.good, **own.success}
    elif operation.status != 200:
        kind = answer_to(operation.request)
        found[operation.status] = {"description": operation.good, "content": content(kind)}
    return found
