"""Every message that crosses a process boundary of the appliance, by link.

A message is a frozen struct with a tag of its own name; a link accepts only the messages of its union, so a process
cannot receive any other kind of message. A struct that travels with file descriptors has `descriptors`; they are sent
as SCM_RIGHTS with the message and delivered with it.

Strings from unknown hosts (names, header values) are carried as values and never interpreted on the way.

Every message that is defined in these files is in `messages`, without another list. The exception is `messages.api`,
which imports every request of operators: only the two ends of its link import it.
"""

# ruff: noqa: F403  so that a new message need not be listed
from appliance.channel.answers.status import ProcessInfo as ProcessInfo
from appliance.channel.messages.compiler import *
from appliance.channel.messages.forwarding import *
from appliance.channel.messages.lifeline import *
from appliance.channel.messages.message import *
from appliance.channel.messages.recorder_link import *
from appliance.channel.messages.relay_link import *
from appliance.channel.messages.signer_link import *
from appliance.channel.messages.tunnels import *
