"""Every message that crosses a process boundary of the appliance, by link.

A message is a frozen struct with a tag of its own name; a link accepts only the messages of its union, so a
process cannot be told anything that is not written here. A struct that travels with file descriptors says so in
`descriptors`; they are sent as SCM_RIGHTS with the message and delivered with it.

Strings from strangers (names, header values) are carried as values and never interpreted on the way.

A message that is written in one of these files is one of `messages`: nothing else is to be listed. But for those of
the link to the api, which bring every request of operators: only its two ends import `messages.api`.
"""

# ruff: noqa: F403  a new message is listed by being written
from appliance.channel.answers.status import ProcessInfo as ProcessInfo
from appliance.channel.messages.compiler import *
from appliance.channel.messages.forwarding import *
from appliance.channel.messages.lifeline import *
from appliance.channel.messages.message import *
from appliance.channel.messages.recorder_link import *
from appliance.channel.messages.relay_link import *
from appliance.channel.messages.signer_link import *
from appliance.channel.messages.tunnels import *
