"""What operators ask about access tokens of REST."""

from typing import cast

from appliance.channel import admin
from appliance.channel.answers.tokens import NewToken, Token, TokenRole
from appliance.channel.answers.tokens import Tokens as AllTokens
from appliance.control.tokens import Tokens
from appliance.store.tokens import TokenRow


class TokenOrders:
    """Each method answers the request that it takes. They raise `TokenRefusedError`."""

    def __init__(self, tokens: Tokens) -> None:
        self._tokens = tokens

    async def add(self, request: admin.TokenAdd) -> NewToken:
        """Make a token."""
        row, text = await self._tokens.add(request.name, request.role, request.seconds)
        return NewToken(*_fields(row), token=text)

    async def listed(self, _request: admin.TokenList) -> AllTokens:
        """All tokens that were made."""
        return AllTokens([_token(row) for row in self._tokens.rows()])

    async def revoke(self, request: admin.TokenRevoke) -> Token:
        """End a token."""
        return _token(await self._tokens.revoke(request.name))


def _token(row: TokenRow) -> Token:
    return Token(*_fields(row))


def _fields(row: TokenRow) -> tuple[str, str, TokenRole, float, float, float | None]:
    return row.name, row.id, cast(TokenRole, row.role), row.created, row.expires, row.revoked
