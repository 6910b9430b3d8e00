"""Build the contract: FastAPI's OpenAPI document, corrected where this application differs."""

import json
from importlib.resources import files
from typing import Any

import msgspec
from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from appliance.api.front import moments
from appliance.api.front.problems import MEDIA_TYPE, Problem
from appliance.api.front.routing import CONTRACT
from appliance.api.routes.log_reader import RECORD

# Answers that the request gate may give to any call.
_ALWAYS = {
    "403": "The request is from a page of another site, or not for this role.",
    "408": "The body did not arrive in time.",
    "413": "The body is too large.",
    "421": "The appliance does not answer to this host name.",
    "429": "Too many requests from this host.",
}
_WITH_TOKEN = {
    "401": "No token, or a wrong, expired or revoked one.",
    "503": "The appliance cannot answer now.",
}
GENERAL = frozenset({"400", *_ALWAYS, *_WITH_TOKEN})
"""The statuses that calls may answer whatever they do; the page lists them once."""
_NOT_HTTP = "The request is not HTTP, or its first line or headers are too long (64 KiB); the text is the server's own."
_HASH = {"description": "ETag of this body; If-None-Match takes it", "schema": {"type": "string"}}
_REFERENCE = CONTRACT.reference(Problem)
# Requests and answers of a real appliance, with long texts and lists cut. The key is the kind of the body, or the
# operation for a body without a kind. Answers get their fields with defaults, and their times as RFC 3339.
EXAMPLES: dict[str, Any] = json.loads(files(__package__).joinpath("examples.json").read_text("utf-8"))


def contract_of(app: FastAPI) -> dict[str, Any]:
    if app.openapi_schema is None:
        app.openapi_schema = _make(app)
    return app.openapi_schema


def _make(app: FastAPI) -> dict[str, Any]:
    document = get_openapi(
        title=app.title,
        version=app.version,
        description=app.description,
        routes=app.routes,
        separate_input_output_schemas=False,
    )
    components = document.setdefault("components", {}).setdefault("schemas", {})
    for name in ("HTTPValidationError", "ValidationError"):
        components.pop(name, None)
    components |= _plain(CONTRACT.components())
    components["AuditRecord"] = RECORD
    kinds = {kind.__name__: kind for kind in CONTRACT.kinds}
    bodies = {
        body["schema"].get("$ref", "").rpartition("/")[2]
        for path in document["paths"].values()
        for operation in path.values()
        for body in operation.get("requestBody", {}).get("content", {}).values()
    }
    for kind, schema in components.items():
        moments.describe(schema)
        if kind in EXAMPLES:
            shown = kind in bodies or kind not in kinds
            schema["examples"] = [EXAMPLES[kind] if shown else _as_answered(EXAMPLES[kind], kinds[kind])]
    for path in document["paths"].values():
        for method, operation in path.items():
            _complete(operation)
            _add_examples(operation)
            if method == "get":
                _add_tags(operation["responses"])
    return document


def _as_answered(example: object, kind: type[msgspec.Struct]) -> object:
    """Return the example with the fields that have defaults, and with each time written twice."""
    return json.loads(msgspec.json.encode(moments.in_full(msgspec.convert(example, kind))))


def _plain(schema: Any) -> Any:
    """Return the schema without `items: false`, because client generators take a tuple's length from `maxItems`."""
    if isinstance(schema, list):
        return [_plain(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    return {name: _plain(part) for name, part in schema.items() if not (name == "items" and part is False)}


def _add_tags(responses: dict[str, Any]) -> None:
    good = responses["200"]
    if "application/json" in good.get("content", {}) and "ETag" not in good.get("headers", {}):
        good.setdefault("headers", {})["ETag"] = _HASH
        responses["304"] = {
            "description": "The body has the ETag in If-None-Match.",
            "headers": {"ETag": _HASH},
        }


def _add_examples(operation: dict[str, Any]) -> None:
    name = operation["operationId"]
    if name in EXAMPLES:
        (answer,) = operation["responses"]["200"]["content"].values()
        answer["example"] = EXAMPLES[name]
    body = operation.get("requestBody", {}).get("content", {})
    if "text/plain" in body:
        kind = body["application/json"]["schema"]["$ref"].rpartition("/")[2]
        body["text/plain"]["example"] = EXAMPLES[kind]["text"]


def _complete(operation: dict[str, Any]) -> None:
    responses = operation["responses"]
    more = _ALWAYS | (_WITH_TOKEN if operation.get("security") else {})
    for status, text in more.items():
        responses.setdefault(status, {"description": text})
    for status, response in responses.items():
        if int(status) >= 400:
            if response["description"] == "Validation Error":
                response["description"] = "A parameter or the body is invalid."
            response["content"] = {MEDIA_TYPE: {"schema": _REFERENCE}}
    words = responses.setdefault("400", {"description": _NOT_HTTP}).setdefault("content", {})
    words["text/plain"] = {"schema": {"type": "string"}}
