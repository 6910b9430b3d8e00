"""Every message that crosses a process boundary of the appliance, by link.

A link accepts only the messages of its union. Strings from unknown hosts (names, header values) are values, never
interpreted on the way. `messages.api` is not imported here, because it needs all requests of operators.
"""

# ruff: noqa: F403  so that a new message need not be listed
from appliance.channel.answers.status import ProcessInfo as ProcessInfo
from appliance.channel.messages.compiler import *
from appliance.channel.messages.forwarding import *
from appliance.channel.messages.lifeline import *
from appliance.channel.messages.message import *
from appliance.channel.messages.relay_link import *
from appliance.channel.messages.signer_link import *
from appliance.channel.messages.tunnels import *
