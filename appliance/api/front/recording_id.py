"""Match the id of a recording in a path."""

from typing import Annotated

from fastapi import Path
from starlette.convertors import StringConvertor, register_url_convertor

OneId = Annotated[
    str, Path(pattern="^[0-9a-f]{20}$", description="id of the recording", examples=["18ea0bb9b11c1024196c"])
]


class _MeantId(StringConvertor):
    """Matches what may be meant as a recording's id, so that a wrong one is named (422); not the word `memory`."""

    regex = "(?!memory(?:/|$))[^/]+"


register_url_convertor("recording", _MeantId())
CONVERTORS = {"{recording_id}": "{recording_id:recording}"}
"""The name of each converter in the contract, and as Starlette matches it."""
