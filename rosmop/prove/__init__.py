"""Prove that the compiled code of an event means the same as its intermediate form, for every message and state.

`module_terms.py` and `form_terms.py` translate both to terms of z3 over the same initial state, and
`equality.py` asks z3 whether the terms can differ. With `rosmop/fast` they share only addresses, sizes and
the format of output. No process of the appliance loads z3.
"""
