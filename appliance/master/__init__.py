"""RVMaster: stands where nodes expect the ROS Master, decides every request and forwards what is granted.

The way of a request: `http` (socket, limits) → `pipeline` (parse, canonicalise, decide, record, perform, answer)
by the rows of `calls`; `gate` is the one decision point; `registry` knows who is who; `faces` stand between
nodes; `reconcile` mends the difference between what is wanted and what is seen.
"""
