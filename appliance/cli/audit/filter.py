"""Give verbs the filter options of `rosrv audit search`, `tail` and `export`."""

import functools
import inspect
from collections.abc import Callable
from typing import Concatenate, ParamSpec

from appliance.api.front.unrecorded import unrecorded
from appliance.api.routes.named_hosts import has_name, with_networks
from appliance.audit.log.record_format import printable
from appliance.audit.search.filter_options import filter_given
from appliance.audit.search.query import Filter, FilterError
from appliance.channel.admin import PolicyWanted
from appliance.channel.answers.policy_answers import PolicyKnown
from appliance.cli.audit.audit_errors import Errors, note
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance

_P = ParamSpec("_P")


def filtered(
    verb: Callable[Concatenate[Appliance, Filter, _P], None],
) -> Callable[Concatenate[Appliance, _P], None]:
    """Replace a verb's second parameter, a `Filter`, by the filter options."""
    options = inspect.signature(
        filter_given
    ).parameters  # typer reads the options of a verb from its signature only

    @functools.wraps(verb)
    def asked(appliance: Appliance, *args: _P.args, **kwargs: _P.kwargs) -> None:
        with Errors():
            given = {name: kwargs.pop(name) for name in options}
            wanted = filter_given(**given)  # type: ignore[arg-type]  # as the options say
            for warning in unrecorded(wanted):
                note(printable(warning))
            if has_name(wanted) and appliance.place is None:  # over REST, the appliance looks the name up
                wanted = with_networks(wanted, _known(appliance, wanted))
            verb(appliance, wanted, *args, **kwargs)

    own = inspect.signature(verb, eval_str=True)
    first, _wanted, *rest = own.parameters.values()
    asked.__signature__ = own.replace(parameters=[first, *options.values(), *rest])  # type: ignore[attr-defined]  # what `speaks` reads
    return asked  # type: ignore[return-value]  # mypy gives the appliance a name that it is not called by


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
