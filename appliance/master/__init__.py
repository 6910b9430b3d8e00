"""RVMaster: listens where nodes expect the ROS master, decides every request and forwards granted ones.

The path of a request: `http` (socket, limits) → `pipeline` (parse, canonicalise, decide, record, perform, answer), by
the rows of the call table. `gate` makes all decisions, `registry` has nodes and registrations, `endpoints` has the
proxies between nodes, and `reconcile` makes the ROS master match the registry.
"""
