"""Make the filter of `rosrv audit search`, `tail` and `export` from their options."""

from appliance.api.front.unrecorded import unrecorded
from appliance.api.routes.named_hosts import has_name, with_networks
from appliance.audit.log.record_format import printable
from appliance.audit.search.filter_options import FILTER
from appliance.audit.search.query import Filter, FilterError
from appliance.channel.admin import PolicyWanted
from appliance.channel.answers.policy_answers import PolicyKnown
from appliance.cli.audit.audit_errors import note
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance


def filter_of(appliance: Appliance) -> Filter:
    """Return the filter that the options choose, with the networks of a host's name. Raises `FilterError`."""
    wanted = FILTER.value(appliance.params)
    for warning in unrecorded(wanted):
        note(printable(warning))
    if has_name(wanted) and appliance.place is None:  # over REST, the appliance looks the name up
        return with_networks(wanted, _known(appliance, wanted))
    return wanted


def _known(appliance: Appliance, wanted: Filter) -> PolicyKnown:
    """Return the policy in force, which has the names of hosts. Raises `FilterError` if no appliance answers."""
    try:
        answer = appliance.ask(PolicyWanted())
    except NotRunningError:
        raise FilterError(
            f"--host {wanted.host}: only the running appliance knows the names of hosts; give an address or a glob"
        ) from None
    if not answer.ok:
        raise FilterError(f"--host {wanted.host}: {answer.error}")
    return answer.given()
