"""Make the core of RVMaster, which decides calls and changes the graph, but sends no messages."""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.control.assembly.current import Current
from appliance.control.assembly.foundation import Foundation
from appliance.master.calls.gate import CallGate, HostLimits
from appliance.master.calls.parameter_calls import ParameterRights
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.graph import Grants, RosGraph
from appliance.master.graph.registry import Registry
from appliance.master.graph.revocation import Revocation
from appliance.master.parameter_charges import ParameterCharges
from appliance.master.parameter_mirror import ParameterMirror
from appliance.master.reconcile.liveness import Watchlist
from appliance.policy.policy import Policy
from appliance.quotas.pool import Pool
from appliance.quotas.table import PARAMETER_BYTES
from appliance.specifications.specification_manager import SpecificationManager
from roswire.parameter_tree import Tree


@dataclass(frozen=True, slots=True)
class MasterCore:
    policy: Callable[[], Policy]
    registry: Registry
    watchlist: Watchlist
    carried: RelayTraffic
    grants: Grants
    rights: ParameterRights
    graph: RosGraph
    gate: CallGate
    parameters: ParameterMirror
    revocation: Revocation
    monitors: Current[SpecificationManager]


def make_master_core(base: Foundation) -> MasterCore:
    settings, registry = base.settings, base.registry
    policy = base.policies.policy

    watchlist = Watchlist()
    carried = RelayTraffic(base.trail, registry, settings.relays, watchlist.cut_off)
    grants = Grants(registry.mark, carried.used)
    rights = ParameterRights(policy, base.trail)
    parameters = _make_mirror(base)

    def tree() -> Tree:
        return parameters.tree

    graph = RosGraph(registry, grants, base.trail)
    limits = HostLimits(settings.limits.topics_per_host)
    return MasterCore(
        policy=policy,
        registry=registry,
        watchlist=watchlist,
        carried=carried,
        grants=grants,
        rights=rights,
        graph=graph,
        gate=CallGate(policy, registry, limits),
        parameters=parameters,
        revocation=Revocation(registry, grants, graph, policy, tree),
        monitors=base.monitors,
    )


def _make_mirror(base: Foundation) -> ParameterMirror:
    whole = int(base.settings.limits.parameter_bytes)
    bounds = PARAMETER_BYTES.bounds.sized(whole, whole // 2)
    pool = Pool("bytes of parameters", bounds, base.quota_class)
    return ParameterMirror(
        base.store.load_parameters(),
        base.parameters_dirty.set,
        ParameterCharges(pool, base.store, base.store.parameter_owners()),
        depth_limit=base.settings.limits.nesting,
        note=base.store.note_parameter,
        together=base.store.database.together,
        since=base.store.parameter_changes(),
    )
