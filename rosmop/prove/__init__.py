"""Proves that the module of an event does what the event's form means, for every message and state.

`decoding.py` decodes the module. `module_terms.py` (the module) and `form_terms.py` (the form) translate a function to
terms of z3 over the same initial state (`terms.py`), and `equality.py` asks z3 whether they can differ. Except for
addresses, this shares no code with the writer of modules (`rosmop/fast`).

Only `rosmop check --prove` and tests import it: no process of the appliance has z3.
"""
