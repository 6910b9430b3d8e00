"""Bodies that are a text as it is, or JSON that has more to say: parsed here, and told what is wrong with them."""

import json
from typing import Annotated, Any, TypeVar

from fastapi import Query
from pydantic import BaseModel, ValidationError

from appliance.api.problems import BadInput, ProblemError

_Model = TypeVar("_Model", bound=BaseModel)
DryRun = Annotated[bool, Query(description="only say what it would do; for operators, without If-Match")]
_NO = frozenset({b"", b"0", b"false", b"off", b"no", b"f", b"n"})
WRONG_TYPE: dict[int | str, dict[str, Any]] = {
    415: {"description": "The body is neither text/plain nor JSON."}
}


def is_dry(query: bytes) -> bool:
    """Whether a request is a dry run, by its query."""
    found = [
        value for name, _eq, value in (one.partition(b"=") for one in query.split(b"&")) if name == b"dry_run"
    ]
    return bool(found) and found[-1].lower() not in _NO


def text_or(model: type[BaseModel]) -> dict[str, Any]:
    """How the contract describes a body that `read_body` reads."""
    return {
        "requestBody": {
            "required": True,
            "content": {
                "application/json": {"schema": model.model_json_schema()},
                "text/plain": {"schema": {"type": "string", "minLength": 1}},
            },
        }
    }


def read_body(content_type: str, body: bytes, model: type[_Model], what: str) -> _Model:
    """A body of type text/plain (the field `text` of the model) or JSON. Raises `ProblemError` (415, 422)."""
    kind = content_type.partition(";")[0].strip().lower()
    if kind not in ("application/json", "text/plain"):
        raise ProblemError(
            415, "wrong-type", f'send {what} as Content-Type text/plain, or as JSON {{"text": …}}'
        )
    try:
        text = body.decode("utf-8")
        fields = json.loads(text) if kind == "application/json" else {"text": text}
        return model.model_validate(fields)
    except UnicodeDecodeError as error:
        raise ProblemError(422, "bad-input", f"the body is not UTF-8 (byte {error.start})") from None
    except json.JSONDecodeError as error:
        raise ProblemError(
            422, "not-json", f"the body is not JSON: {error.msg}", line=error.lineno, column=error.colno
        ) from None
    except RecursionError:
        raise ProblemError(422, "not-json", "the body is nested too deep") from None
    except ValidationError as error:
        found = [
            BadInput(where=".".join(map(str, ("body", *one["loc"]))), text=one["msg"])
            for one in error.errors()
        ]
        detail = "; ".join(f"{one.where}: {one.text}" for one in found[:5])
        raise ProblemError(422, "bad-input", detail, errors=found) from None
    except ValueError:  # of json: a number with thousands of digits
        raise ProblemError(422, "not-json", "the body has a number that is too long") from None
