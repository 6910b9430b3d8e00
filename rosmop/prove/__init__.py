"""Whether the module that was written of an event does what the event's form means, for every message and state.

`decoding.py` reads the module's bytes, `module_terms.py` says what a function of it does, `form_terms.py` what the form
means, both as terms of z3 over the same beginning (`terms.py`), and `equality.py` asks z3 whether they can differ.
Nothing here uses what writes modules (`ir/module.py`, `ir/feed.py`, `ir/wasm.py`) but for where variables stand.

Only `rosrv monitor check --prove` and tests import it: z3 is in no process of the appliance.
"""
