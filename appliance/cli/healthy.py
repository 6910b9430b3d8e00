"""The health check of a container, `python -m appliance.cli.healthy`: exit status 0 while nodes are served.

A standby is healthy while it runs. Problems that do not affect nodes do not count: for them, a container engine
would restart the appliance in vain. The check runs every few seconds, so it imports very little.
"""

import os
import sys
from pathlib import Path

from appliance.channel.admin import StatusWanted
from appliance.channel.status_summary import why_unserved
from appliance.cli.connection.admin_client import AdminSocket, NotRunningError

_STATE = "/var/lib/rosrv"  # the default of the configuration's key `state`
_SECONDS = 4.0


def main() -> None:
    state = Path(os.environ.get("ROSRV_STATE", _STATE))
    try:
        answer = AdminSocket(state, _SECONDS).ask(StatusWanted())
        if answer.trouble == "standby":
            return
        reason = why_unserved(answer.unwrap()) if answer.ok else answer.error
    except NotRunningError as error:
        reason = f"the appliance does not answer: {error}"
    if reason is not None:
        sys.exit(reason)


if __name__ == "__main__":
    main()
