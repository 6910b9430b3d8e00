"""Prove that the compiled code of an event has the meaning of its intermediate form, for every message and state.

`decoding.py` decodes the WebAssembly module. `module_terms.py` (for the module) and `form_terms.py` (for the form)
translate a function to terms of z3 over the same initial state (`terms.py`). `equality.py` asks z3 whether the terms
can differ. Except for addresses, this package shares no code with the writer of modules (`rosmop/fast`).

Only `rosmop check --prove` and tests import this package: no process of the appliance loads z3.
"""
