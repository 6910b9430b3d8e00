"""Check compiled automata against the definitions of their logics, with code of its own.

The certifier shares no code with `rosmop/logics`: it parses the formula again, and follows its meaning beside the
automaton (`check.py`). It reports every property that it did not check to the end. `steps.py` then runs the compiled
module against the certified automata, and lists what it shares with the writer of modules.
"""
