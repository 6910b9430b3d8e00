"""Typed messages between the processes of the appliance, over Unix sockets.

The supervisor starts every process with one end of a socket pair (its *lifeline*) and brokers the links between them: a
link is a socket pair whose ends the supervisor hands out (SCM_RIGHTS). So both ends are known by construction, and
there is no path to find or guess.

`messages` defines the messages, `channel` carries them.
"""
