"""Make routes whose handlers take and return structs (msgspec): parse, encode, and add schemas to the contract."""

import enum
import functools
import json
import typing
from collections.abc import Awaitable, Callable
from typing import Any, Generic, NamedTuple, TypeVar

import msgspec
from fastapi import APIRouter, Depends, Request, Response, params

from appliance.api.front.etags import etag
from appliance.api.front.moments import in_full
from appliance.api.front.problems import BadInput, ProblemError, bad_input
from appliance.base.validation_messages import meant, refused_field

A = TypeVar("A")
Responses = dict[int | str, dict[str, Any]]
ETAG = {"ETag": {"description": "the ETag for If-Match of the next change", "schema": {"type": "string"}}}
_JSON = "application/json"
_MAX_ERRORS = 50
_MAX_SHOWN = 5


class Tagged(NamedTuple, Generic[A]):
    """An answer with the revision or tag that becomes its ETag."""

    body: A
    tag: int | str


def with_tag(body: A) -> Tagged[A]:
    return Tagged(body, getattr(body, "tag", None) or body.revision)  # type: ignore[attr-defined]  # each versioned answer has a revision


def answer(body: object, status: int = 200, tag: int | str | None = None) -> Response:
    headers = None if tag is None else {"ETag": etag(tag)}
    return Response(msgspec.json.encode(in_full(body)), status, headers, _JSON)


class Contract:
    """Collects the structs of the contract."""

    def __init__(self) -> None:
        self.kinds: set[Any] = set()

    def reference(self, kind: Any) -> dict[str, Any]:
        self.kinds.add(kind)
        return {"$ref": f"#/components/schemas/{kind.__name__}"}

    def components(self) -> dict[str, Any]:
        kinds = sorted(self.kinds, key=lambda kind: str(kind.__name__))
        return msgspec.json.schema_components(kinds, ref_template="#/components/schemas/{name}")[1]


CONTRACT = Contract()


def content(kind: Any) -> dict[str, Any]:
    return {_JSON: {"schema": CONTRACT.reference(kind)}}


def file(media_type: str, description: str, *, binary: bool = False) -> Responses:
    schema = {"type": "string"} | ({"format": "binary"} if binary else {})
    return {200: {"description": description, "content": {media_type: {"schema": schema}}}}


class _Body:
    """Parses a body; one sent as text/plain becomes the field `text`."""

    def __init__(self, kind: Any, text: str | None) -> None:
        self.kind = kind
        self.text = text

    async def __call__(self, request: Request) -> object:
        """Return the struct. Raises `ProblemError` (415, 422)."""
        content_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        if content_type == "text/plain" and self.text is not None:
            return self._of_text(_text(await request.body()))
        if content_type == _JSON:
            return self._of_json(_text(await request.body()))
        if self.text is None:
            raise ProblemError(422, "bad-input", "send a JSON object, as Content-Type application/json")
        what = f'send {self.text} as Content-Type text/plain, or as JSON {{"text": …}}'
        raise ProblemError(415, "wrong-type", what)

    def _of_text(self, text: str) -> object:
        try:
            return msgspec.convert({"text": text}, self.kind)
        except msgspec.ValidationError as error:
            raise bad_input([_bad(error)]) from None

    def _of_json(self, text: str) -> object:
        try:
            try:
                return msgspec.json.decode(text, type=self.kind)
            except msgspec.ValidationError as error:
                # msgspec reports the first wrong field; invalid JSON may follow this field.
                wrong = _all_wrong(msgspec.json.decode(text), self.kind) or [_bad(error)]
        except (ValueError, RecursionError) as error:
            raise _not_json(text, error) from None
        raise bad_input(wrong)

    def schema(self) -> dict[str, Any]:
        kinds = content(self.kind)
        if self.text is not None:
            kinds["text/plain"] = {"schema": {"type": "string", "minLength": 1}}
        return {"requestBody": {"required": True, "content": kinds}}

    def responses(self) -> Responses:
        wrong: Responses = {422: {"description": "A parameter or the body is invalid."}}
        if self.text is not None:
            wrong[415] = {"description": "The body is neither text/plain nor JSON."}
        return wrong


def _text(data: bytes) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ProblemError(422, "bad-input", f"the body is not UTF-8 (byte {error.start})") from None


def _all_wrong(given: Any, kind: Any) -> list[BadInput]:
    """Return all mistakes, because msgspec stops at the first one."""
    if not isinstance(given, dict):
        return []
    known = {field.encode_name: field for field in msgspec.structs.fields(kind)}
    wrong = [
        BadInput("body", f"the field `{name}` must be given")
        for name, field in known.items()
        if field.required and name not in given
    ]
    for name, value in given.items():
        if name not in known:
            wrong.append(BadInput("body", f"there is no field `{name[:100]}`{meant(name, known)}"))
            continue
        try:
            msgspec.convert(value, known[name].type)
        except msgspec.ValidationError as error:
            wrong.append(_bad(error, f"body.{name}", known[name].type))
    return wrong[:_MAX_ERRORS]


def _bad(error: msgspec.ValidationError, where: str = "body", kind: Any = None) -> BadInput:
    return BadInput(*refused_field(error, where, _choices(kind)))


def _choices(kind: Any) -> tuple[str, ...]:
    parts = typing.get_args(kind)
    if isinstance(kind, type) and issubclass(kind, enum.StrEnum):
        return tuple(kind)
    if typing.get_origin(kind) is typing.Literal:
        return parts
    return next(filter(None, map(_choices, parts)), ())


def _not_json(text: str, error: Exception) -> ProblemError:
    try:
        json.loads(text)
    except json.JSONDecodeError as found:
        detail = f"the body is not JSON: {found.msg}"
        return ProblemError(422, "not-json", detail, line=found.lineno, column=found.colno)
    except (RecursionError, ValueError):  # a number with thousands of digits
        pass
    return ProblemError(422, "not-json", f"the body is not JSON: {error}")


def body(kind: type, *, text: str | None = None) -> object:
    return Depends(_Body(kind, text))


class Routes(APIRouter):
    """Routes whose handlers take and return structs."""

    def add_api_route(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        options["operation_id"] = options.get("operation_id") or options.get("name") or endpoint.__name__
        hints = typing.get_type_hints(endpoint, include_extras=True)
        roles: list[Any] = list(options.get("dependencies") or ())
        for part in [part for hint in hints.values() for part in getattr(hint, "__metadata__", ())]:
            if isinstance(getattr(part, "dependency", None), _Body):
                options["openapi_extra"] = part.dependency.schema()
                options["responses"] = part.dependency.responses() | (options.get("responses") or {})
            elif isinstance(part, params.Depends):
                roles.append(part)
        # A request is judged only for its roles, whatever the order of the handler's parameters.
        options["dependencies"] = [*roles, Depends(_only_known)]
        given = options.get("response_model") or hints.get("return")
        tagged = typing.get_origin(given) is Tagged
        kind = typing.get_args(given)[0] if tagged else given
        if tagged or (isinstance(kind, type) and issubclass(kind, msgspec.Struct)):
            good = {"content": content(kind), **({"headers": ETAG} if tagged else {})}
            options["responses"] = {200: {"description": "OK", **good}} | (options.get("responses") or {})
            options["response_model"] = None
            endpoint = _encode(endpoint)
        super().add_api_route(path, endpoint, **options)


async def _only_known(request: Request) -> None:
    """Raises `ProblemError` (422) for parameters that the contract lacks, but not for pages outside the contract."""
    given = request.query_params.keys()
    if not given:
        return
    operation = _operations_at(request).get(request.method.lower())
    if operation is None:
        return
    known = [parameter["name"] for parameter in operation.get("parameters", []) if parameter["in"] == "query"]
    unknown = [name for name in dict.fromkeys(given) if name not in known][:_MAX_SHOWN]
    if unknown:
        there_are = f"there are: {', '.join(known)}" if known else "this path takes none"
        bad = [
            BadInput(where=f"query.{name}", text=f"there is no such parameter{meant(name, known)}")
            for name in unknown
        ]
        raise bad_input(bad, besides=f"; {there_are}")


def _operations_at(request: Request) -> dict[str, Any]:
    """Return the contract's operations of a route, whose own path lacks the prefix of the router that includes it."""
    paths: dict[str, dict[str, Any]] = request.app.openapi()["paths"]
    own = request.scope["route"].path
    prefixes = [path.removesuffix(own) for path in paths if path.endswith(own)]
    fitting = [prefix for prefix in prefixes if request.url.path.startswith(prefix)]
    return paths[max(fitting, key=len) + own] if fitting else {}


def _encode(endpoint: Callable[..., Awaitable[object]]) -> Callable[..., Awaitable[Response]]:
    @functools.wraps(endpoint)
    async def wrapper(*arguments: object, **named: object) -> Response:
        given = await endpoint(*arguments, **named)
        return answer(given.body, tag=given.tag) if isinstance(given, Tagged) else answer(given)

    return wrapper
