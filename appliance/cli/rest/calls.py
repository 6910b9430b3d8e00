"""What makes calls of REST, as the verbs' orders see it."""

from typing import Any, Protocol


class Calls(Protocol):
    """Makes calls of REST."""

    url: str

    def call(
        self,
        method: str,
        path: str,
        *,
        params: Any = None,
        body: Any = None,
        seconds: float | None = 60.0,
        match: bool = False,
    ) -> dict[str, Any]:
        """The answer's body."""
