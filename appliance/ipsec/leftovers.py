"""Remove IPsec states and policies, with their keys, that a killed charon left in the kernel.

With them the kernel would accept packets even from a revoked host. Only the appliance's own leftovers are
removed: states of ESP in UDP on port 4500, and policies from and to its tunnel address.
"""

import itertools
import re
import subprocess

_SECONDS = 10.0
_STATE = re.compile(r"^src (\S++) dst (\S++)[ \t]*+\n\s++proto esp spi (0x[0-9a-f]++)", re.MULTILINE)
_ENCAPSULATED = re.compile(r"^\s++encap type espinudp sport (\d++) dport (\d++)", re.MULTILINE)
_POLICY = re.compile(r"^src (\S++) dst (\S++).*+\n\s++dir (in|out|fwd)\b", re.MULTILINE)
_PORT = "4500"


class LeftoversError(Exception):
    """The kernel did not remove states or policies."""


def clear_leftovers(own: str) -> int:
    """Remove the leftovers; return their number. Raises `LeftoversError`.

    charon must not run in the calling thread's network namespace. `own` is the appliance's address in the tunnels.
    """
    orders = _orders(own)
    if orders:
        _ip("-force", "-batch", "-", text="".join(f"{order}\n" for order in orders))
        left = _orders(own)
        if left:
            raise LeftoversError(f"the kernel still has state of an earlier charon: {'; '.join(left)[:400]}")
    return len(orders)


def state_orders(listed: str) -> list[str]:
    starts = [*(found.start() for found in re.finditer(r"^src ", listed, re.MULTILINE)), len(listed)]
    orders = []
    for begin, end in itertools.pairwise(starts):
        state = _STATE.match(listed[begin:end])
        encapsulated = _ENCAPSULATED.search(listed[begin:end])
        if state is not None and encapsulated is not None and _PORT in encapsulated.groups():
            orders.append(f"xfrm state delete src {state[1]} dst {state[2]} proto esp spi {state[3]}")
    return orders


def policy_orders(listed: str, own: str) -> list[str]:
    return [
        f"xfrm policy delete src {source} dst {destination} dir {direction}"
        for source, destination, direction in _POLICY.findall(listed)
        if f"{own}/32" in (source, destination)
    ]


def _orders(own: str) -> list[str]:
    return [*policy_orders(_ip("xfrm", "policy"), own), *state_orders(_ip("xfrm", "state", "list", "nokeys"))]


def _ip(*arguments: str, text: str = "") -> str:
    try:
        done = subprocess.run(
            ["ip", *arguments], input=text, capture_output=True, text=True, timeout=_SECONDS, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise LeftoversError(f"the kernel's state of an earlier charon is unknown: {error}") from error
    # A kernel without IPsec rejects the query; it has no states or policies.
    if done.returncode and not text and "not supported" not in done.stderr:
        raise LeftoversError(
            f"the kernel's state of an earlier charon is unknown: {done.stderr.strip()[:200]}"
        )
    return done.stdout
