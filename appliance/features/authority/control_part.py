"""Build the part of control for command authority."""

from appliance.control.core import ControlPart, Core
from appliance.control.motion_stop import MotionStop
from appliance.control.operators.request_method import RequestMethod
from appliance.features.authority import requests
from appliance.features.authority.orders import DriveOrders
from appliance.features.authority.ranked_groups import RankedGroups
from appliance.features.authority.settings import GIVE, TAKE


async def begin(core: Core) -> ControlPart:
    """Begin without a holder of any group, and stop motions that earlier holders commanded."""
    policy = core.policy
    stop = MotionStop(core.relay.stop, core.trail, policy.current)
    ranked = RankedGroups(
        policy.current,
        core.trail,
        core.relay,
        stop.after,
        node=core.settings.publish_as,
        find=lambda key: ((name := core.graph.name_of(key)), core.graph.host_of(name)),
    )
    orders = DriveOrders(
        policy.current,
        core.trail,
        core.graph.signs,
        stop.after,
        ranked,
        decide_again=policy.decide_again,
        carried_out=core.relay.carried_out,
        relays_ready=core.relay.ready,
    )
    at_start = stop.of_published_before(
        core,
        lambda: bool(policy.current().authority),
        lambda _host, topic: (
            (group := policy.current().command_group(topic)) is not None and ranked.forgot(group)
        ),
    )
    policy.provide(lambda known: known.with_holders(orders.holders()))
    policy.on_change(orders.policy_changed)
    policy.on_first(ranked.policy_changed)
    core.own_services.provide(TAKE, orders.take_called)
    core.own_services.provide(GIVE, orders.give_called)
    return ControlPart(
        (
            RequestMethod(requests.DriveStatus, orders.status),
            RequestMethod(requests.DriveTake, orders.take, who=True, full_disk=True),
            RequestMethod(requests.DriveGive, orders.give, who=True, full_disk=True),
            RequestMethod(requests.DriveAsk, orders.ask, who=True, full_disk=True),
        ),
        {
            "the silence of holders": orders.watch,
            "the stop of drivers that were lost": ranked.stop_lost,
            "the stop of what was commanded before groups ended": at_start,
        },
        lambda: {"authority": orders.unheard()},
    )
