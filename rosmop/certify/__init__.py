"""Check compiled automata against the definitions of their logics, with separate code.

The certifier shares no code with `rosmop/logics`: it parses the formula again, and follows its meaning step by step
beside the automaton (`check.py`). It reports every property that it could not check completely.
"""
