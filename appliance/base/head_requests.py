"""Answer HEAD requests like GET, without the body (RFC 9110, section 9.3.2)."""

from starlette.types import ASGIApp, Message, Receive, Scope, Send


class AnswersHead:
    """An application that sees GET instead of HEAD. The server still sees HEAD, and sends no body."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope.get("method") != "HEAD":
            await self._app(scope, receive, send)
            return
        ended = False

        async def send_head(message: Message) -> None:
            nonlocal ended
            if not ended:
                await send(message)
            if message["type"] == "http.response.start":
                ended = True  # an answer that never ends, such as a stream of records, ends here
                await send({"type": "http.response.body"})

        await self._app({**scope, "method": "GET"}, receive, send_head)
