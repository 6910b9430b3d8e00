from typing import Any

from appliance.control.operators.administration import Administration
from appliance.control.operators.request_method import RequestMethod


async def _durable() -> None: ...


def administration_of(*methods: RequestMethod[Any]) -> Administration:
    """Return control's administration with these methods, for which the disk has room."""
    return Administration(
        methods, in_force=lambda: (1, 1), durable=_durable, require_room=lambda: None, obstacle=lambda: None
    )
