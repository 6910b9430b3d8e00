"""The health check of the collector's container, `python -m rosrv_fleet.healthy`: exit status 0 if it answers.

The check runs every few seconds, so it imports very little.
"""

import os
import ssl
import sys
import urllib.request
from pathlib import Path

from rosrv_fleet.config import FleetConfig, FleetConfigError, load_config

_DEFAULT = "/etc/rosrv-fleet/fleet.yaml"
_SECONDS = 5.0


def check(config: FleetConfig) -> None:
    context = ssl.create_default_context(cafile=config.certificate)
    context.check_hostname = False  # it may name another address of this machine
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # exactly this certificate
    host, port = config.address
    host = "127.0.0.1" if host in ("", "0.0.0.0", "::") else host  # noqa: S104  all addresses, so also this one
    url = f"https://{f'[{host}]' if ':' in host else host}:{port}/healthz"
    with urllib.request.urlopen(url, timeout=_SECONDS, context=context):
        pass


def main() -> None:
    try:
        check(load_config(Path(os.environ.get("ROSRV_FLEET_CONFIG", _DEFAULT))))
    except (FleetConfigError, OSError) as error:
        sys.exit(f"the collector does not answer: {error}")


if __name__ == "__main__":
    main()
