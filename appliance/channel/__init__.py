"""Typed messages between the processes of the appliance, over Unix sockets.

A *lifeline* connects each process with the supervisor, a *link* connects two processes. Both are socket pairs from the
supervisor, so no other process can find a path to them.
"""
