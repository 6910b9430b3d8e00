"""Query parameters that a path does not have are refused: a filter that is misspelt would find everything."""

from fastapi import Request

from appliance.api.problems import BadInput, bad_input
from appliance.base.validation_messages import meant

_MOST_SHOWN = 5


async def only_known(request: Request) -> None:
    """Let a call pass whose query has only parameters of the contract. Raises `ProblemError` (422).

    Pages outside the contract (the console) take what they are given.
    """
    given = request.query_params.keys()
    if not given:
        return
    operations = request.app.openapi()["paths"].get(request.scope["route"].path, {})
    operation = operations.get(request.method.lower())
    if operation is None:
        return
    known = [parameter["name"] for parameter in operation.get("parameters", []) if parameter["in"] == "query"]
    unknown = [name for name in dict.fromkeys(given) if name not in known][:_MOST_SHOWN]
    if unknown:
        there_are = f"there are: {', '.join(known)}" if known else "this path takes none"
        bad = [
            BadInput(where=f"query.{name}", text=f"there is no such parameter{meant(name, known)}")
            for name in unknown
        ]
        raise bad_input(bad, besides=f"; {there_are}")
