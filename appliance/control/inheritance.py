"""Pass the state of monitors from one appliance to the other.

The replicated setting `active appliance` has the name and epoch of the appliance whose relays passed the last messages.
It is stored only after all relays have taken the inherited state: a control that dies before inherits again. In a
planned switchover, the relays first drop all messages and leave their state, which is stored before the lease is given
up. After any other takeover the state is lost: monitors that act by their state hold their topics.
"""

from collections.abc import Callable

import msgspec

from appliance.control.lease_client import HandOverError
from appliance.control.replication import Pair
from appliance.specifications.rollout import InheritedState, Rollout
from appliance.store.state_file import StateStore

_ACTIVE = "active appliance"
_LEAVE_SECONDS = 2.0


class _Active(msgspec.Struct, frozen=True):
    name: str
    epoch: int


def inherited_state(pair: Pair, store: StateStore) -> tuple[InheritedState, Callable[[], None]]:
    """Return the state that this appliance's relays start with, and the function to call once they have it."""
    own = _Active(pair.membership.name, pair.epoch)

    def taken() -> None:
        with store.database.together():
            store.save_setting(_ACTIVE, msgspec.json.encode(own).decode())
            store.clear_monitor_states()

    text = store.settings().get(_ACTIVE)
    last = msgspec.json.decode(text, type=_Active) if text is not None else own
    if last.name == own.name:
        return InheritedState(), taken
    left = store.monitor_states(last.epoch) if last.epoch == pair.epoch - 1 else []
    if left:
        return InheritedState(left=tuple(left)), taken
    return InheritedState(
        f"the appliance {last.name} was active, and its monitors' state is lost with it"
    ), taken


async def leave_state(pair: Pair, store: StateStore, rollout: Rollout) -> None:
    """Stop the relays, and store the state of their monitors. Raises `HandOverError` if a relay does not answer."""
    try:
        contents = await rollout.leave(_LEAVE_SECONDS)
    except (TimeoutError, ConnectionError) as error:
        raise HandOverError("a relay does not answer; try again") from error
    for index, content in enumerate(contents):
        store.save_monitor_state(index, pair.epoch, content)
