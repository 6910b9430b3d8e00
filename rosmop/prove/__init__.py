"""Prove that the compiled code of an event means the same as its intermediate form, for every message and state.

`module_terms.py` and `form_terms.py` translate a function of the module and of the form to terms of z3 over the same
initial state (`terms.py`), and `equality.py` asks z3 whether the terms can differ. Except for addresses, this package
shares no code with the writer of modules (`rosmop/fast`).

Only `rosmop check --prove` and tests import this package: no process of the appliance loads z3.
"""
