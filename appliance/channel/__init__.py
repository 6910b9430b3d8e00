"""Typed messages between the processes of the appliance, over Unix sockets.

The supervisor starts every process with one end of a socket pair, its *lifeline*. A *link* connects two processes: it
is also a socket pair, and the supervisor sends one end to each process (SCM_RIGHTS). So the supervisor determines
both ends of a link, and no other process can find a path to it.
"""
