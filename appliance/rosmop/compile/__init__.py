"""From trees to functions: a specification is checked and written in the intermediate form, and that as Python.

Everything here but `python.py` and `module.py` (which make Python) checks, and makes the form. The Python
is made of numbers, of names that are made here (`v12`, `f3`) and of literals written by `repr`; no identifier and no
string of a specification is ever part of it. It runs with nothing but the names it is given.
"""
