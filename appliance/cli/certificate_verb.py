"""`rosrv certificate`: print the certificate of console and REST, for clients to trust."""

import os
import sys

from appliance.base.owner_access import open_named
from appliance.cli.connection.target import DEFAULT_STATE, State
from appliance.cli.output import Json, say_json, usage_error


def certificate(state: State = DEFAULT_STATE, as_json: Json = False) -> None:
    """Print the certificate of console and REST (PEM): for --api-ca, for curl's --cacert, or for a browser.

    The appliance makes it at its first start. It contains no secret.

    Example: rosrv certificate > certificate.pem
    """
    file = state / "api" / "certificate.pem"
    try:
        with os.fdopen(open_named(file), "rb") as found:
            text = found.read().decode("ascii")
    except FileNotFoundError:
        raise usage_error(
            f"{file} does not exist: give the appliance's state directory with --state; the appliance makes the"
            " certificate at its first start, unless `api` is off",
            "rosrv certificate",
        ) from None
    except PermissionError as error:
        raise usage_error(f"{file}: {error.strerror}; run this as root", "rosrv certificate") from None
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else error.reason
        raise usage_error(f"{file} cannot be read: {why}", "rosrv certificate") from None
    if as_json:
        say_json({"certificate": text})
    else:
        sys.stdout.write(text)
