"""REST: a process of its own that speaks to control over a link, and reads the audit log.

It parses what browsers and scripts send, recognises tokens, and passes on typed requests. It holds no right that
control does not check again where it matters: it cannot make tokens, cannot write the audit log, and RVMaster goes
on when it is flooded, killed or taken over.
"""
