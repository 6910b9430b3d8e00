"""The table of the core's request methods."""

from appliance.channel import admin
from appliance.control.assembly.policies import Policies
from appliance.control.operators.queries import Queries
from appliance.control.operators.request_method import RequestMethod
from appliance.control.operators.token_orders import TokenOrders
from appliance.specifications.specification_manager import SpecificationManager


def request_methods(
    *,
    queries: Queries,
    policies: Policies,
    monitors: SpecificationManager,
    tokens: TokenOrders,
) -> tuple[RequestMethod[object], ...]:
    return (
        RequestMethod(admin.StatusWanted, queries.status, order=False),
        RequestMethod(admin.InventoryWanted, queries.inventory, order=False),
        RequestMethod(admin.GraphWanted, queries.graph, order=False),
        RequestMethod(admin.MonitorsWanted, queries.monitors, order=False),
        RequestMethod(admin.MetricsWanted, queries.metrics, order=False),
        RequestMethod(admin.RegistrationsWanted, queries.registrations, order=False),
        RequestMethod(admin.PolicyReload, policies.reload, who=True),
        RequestMethod(admin.PolicyLoad, policies.load, who=True),
        RequestMethod(admin.PolicyRollback, policies.roll_back, who=True),
        RequestMethod(admin.PolicyConfirm, policies.confirm, who=True),
        RequestMethod(admin.PolicyRevisions, policies.revisions),
        RequestMethod(admin.PolicyWanted, policies.text),
        RequestMethod(admin.PolicyRevisionWanted, policies.one_revision),
        RequestMethod(admin.MonitorRevisions, monitors.revisions),
        RequestMethod(admin.MonitorRevisionWanted, monitors.texts),
        RequestMethod(admin.MonitorLoad, monitors.load, who=True),
        RequestMethod(admin.MonitorTry, monitors.attempt, who=True),
        RequestMethod(admin.MonitorReplace, monitors.replace, who=True),
        RequestMethod(admin.MonitorReload, monitors.reload, who=True),
        RequestMethod(admin.MonitorRemove, monitors.remove, who=True),
        RequestMethod(admin.MonitorRollback, monitors.roll_back, who=True),
        RequestMethod(admin.MonitorConfirm, monitors.confirm, who=True),
        RequestMethod(admin.MonitorSwitch, monitors.switch, who=True),
        RequestMethod(admin.MonitorShadow, monitors.shadow, who=True),
        RequestMethod(admin.MonitorGive, monitors.give, who=True),
        RequestMethod(admin.MonitorResume, monitors.resume, who=True),
        RequestMethod(admin.MonitorValuesWanted, monitors.show_values, who=True, order=False),
        RequestMethod(admin.TokenList, tokens.list_tokens),
        RequestMethod(admin.TokenAdd, tokens.add, who=True),
        RequestMethod(admin.TokenRotate, tokens.rotate, who=True),
        RequestMethod(admin.TokenRevoke, tokens.revoke, who=True, full_disk=True),
    )
