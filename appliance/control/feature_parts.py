"""Keep the parts of control that the features of the table add."""

from collections.abc import Awaitable, Callable

from appliance.control.core import ControlPart, Core
from appliance.control.operators.request_method import RequestMethod
from appliance.features.table import members


class FeatureParts:
    """The parts of all features in control."""

    def __init__(self) -> None:
        self._parts: list[ControlPart] = []

    async def begin(self, core: Core) -> None:
        for begin in members("control_part", "begin"):
            self.add(await begin(core))

    def add(self, part: ControlPart | None) -> None:
        if part is not None:
            self._parts.append(part)

    def methods(self) -> tuple[RequestMethod[object], ...]:
        return tuple(method for part in self._parts for method in part.methods)

    def status(self) -> dict[str, object]:
        return {field: state for part in self._parts for field, state in part.status().items()}

    def work(self) -> dict[str, Callable[[], Awaitable[None]]]:
        return {what: work for part in self._parts for what, work in part.work.items()}
