"""The end of the processes, in less than five seconds whatever they do: asked first, then SIGTERM, then SIGKILL."""

import asyncio
import signal
from collections.abc import Sequence
from contextlib import suppress

import structlog

from appliance.channel.messages import Stop
from appliance.supervisor.process_slot import Post

_STOP_SECONDS = 3.0
_TERMINATE_SECONDS = 0.3
_LAST_SECONDS = 1.0

log = structlog.get_logger()


async def end_all(posts: Sequence[Post], someone_died: asyncio.Event) -> None:
    """End every process; those that outlive control when the others are gone.

    `someone_died` is set after each death, when `Post.life` is None already. No post may be filled meanwhile.
    """
    for post in posts:
        if post.due is not None:
            post.due.cancel()
    await _end([post for post in posts if not post.role.outlives_control], _STOP_SECONDS, someone_died)
    await _end(posts, _LAST_SECONDS, someone_died)


async def _end(posts: Sequence[Post], seconds: float, someone_died: asyncio.Event) -> None:
    for post in posts:
        if post.life is None:
            continue
        if post.life.is_program:
            post.life.kill(signal.SIGTERM)
        else:
            post.life.send(Stop())
    if await _all_gone(posts, seconds, someone_died):
        return
    _signal(posts, signal.SIGTERM)
    if await _all_gone(posts, _TERMINATE_SECONDS, someone_died):
        return
    _signal(posts, signal.SIGKILL)
    await _all_gone(posts, _LAST_SECONDS, someone_died)


def _signal(posts: Sequence[Post], number: signal.Signals) -> None:
    for post in posts:
        if post.life is not None:
            log.warning("process did not end", role=post.role.name, pid=post.life.pid, signal=number.name)
            post.life.kill(number)


async def _all_gone(posts: Sequence[Post], seconds: float, someone_died: asyncio.Event) -> bool:
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            while any(post.life is not None for post in posts):
                someone_died.clear()
                await someone_died.wait()
    return all(post.life is None for post in posts)
