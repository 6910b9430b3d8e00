"""RVMaster listens where nodes expect the ROS master, decides every request, and forwards granted requests.

`rpc.server` receives a request within limits. `calls/pipeline` parses, decides, records and answers the request by the
rows of the call table. `calls/gate` makes all decisions. `graph/registry` has nodes and registrations. `endpoints` has
the proxies between nodes. `reconcile` makes the ROS master match the registry.
"""
