"""Run the client of the provider as a process of the appliance: lifeline, link to control, and sign-ons.

Only this process has the client's secret. The firewall lets only this process reach the provider, and lets it reach
nothing else. Control relies on this process to identify people.
"""

import asyncio
import socket
from pathlib import Path
from typing import Any

import structlog

from appliance.base.input_files import read_given
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.child_process import Child
from appliance.configuration.settings import load_resolved
from appliance.features.sso.errors import ProviderError, SignOnRefusedError
from appliance.features.sso.link import (
    SignOnBegun,
    SignOnConfirmed,
    SignOnFailed,
    SignOnReturned,
    SignOnWanted,
    SsoLink,
)
from appliance.features.sso.provider import Provider
from appliance.features.sso.provider_connection import ProviderConnection
from appliance.features.sso.settings import Sso
from appliance.features.sso.sign_on import SignOns

_log = structlog.get_logger()
_LONGEST_SECRET = 4096
_MAX_AT_ONCE = 32


def main(lifeline_fd: int, config: Path) -> None:
    asyncio.run(_Process(load_resolved(config).of(Sso), lifeline_fd).run())


def make_sign_ons(wanted: Sso) -> SignOns:
    assert wanted.issuer is not None  # noqa: S101  the role runs only with it
    provider = Provider(wanted.issuer, ProviderConnection(wanted).exchange, wanted.keys_hours * 3600)
    return SignOns(wanted, provider, lambda: _secret(wanted.client_secret_file))


class _Process:
    def __init__(self, wanted: Sso, lifeline_fd: int) -> None:
        lifeline = Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline)
        self._child = Child(lifeline, SsoLink, said=self._said)
        self._sign_ons = make_sign_ons(wanted)
        self._tasks: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        self._child.attach(messages.Ready())
        await self._child.ended.wait()
        for task in self._tasks:
            task.cancel()

    def _said(self, message: Any) -> None:
        if len(self._tasks) >= _MAX_AT_ONCE:
            self._child.tell(
                SignOnFailed(message.number, "too many sign-ons at once: try again", refused=False)
            )
            return
        task = asyncio.get_running_loop().create_task(self._serve(message))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, message: SignOnWanted | SignOnReturned) -> None:
        try:
            self._child.tell(await self._answer(message))
        except SignOnRefusedError as error:
            self._child.tell(SignOnFailed(message.number, str(error), refused=True))
        except ProviderError as error:
            _log.warning("the provider of single sign-on fails", reason=str(error))
            self._child.tell(SignOnFailed(message.number, str(error), refused=False))
        except Exception as error:  # noqa: BLE001  a defect affects only this sign-on
            _log.exception("a sign-on failed")
            reason = f"a defect of rosrv: {type(error).__name__}"
            self._child.tell(SignOnFailed(message.number, reason, refused=False))

    async def _answer(self, message: SignOnWanted | SignOnReturned) -> messages.Message:
        match message:
            case SignOnWanted(number, keys, address, again):
                return SignOnBegun(number, *await self._sign_ons.begin(keys, address, again=again))
            case SignOnReturned(number, state, code, issuer):
                return SignOnConfirmed(number, *await self._sign_ons.finish(state, code, issuer))
            case _:
                raise TypeError(f"control sent {type(message).__name__}, which is not for sso")


def _secret(file: Path | None) -> str | None:
    """Read the secret for each use, so that a replaced file applies."""
    if file is None:
        return None
    lines = read_given(file, _LONGEST_SECRET).decode().splitlines()
    if not lines or not lines[0]:
        raise ValueError(f"{file} is empty")
    return lines[0]
