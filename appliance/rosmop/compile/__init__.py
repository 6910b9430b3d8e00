"""From trees to functions: Python source is generated from the checked specification, and compiled.

The source is made of numbers, of names that are made here (`v12`, `f3`) and of literals written by `repr`; no
identifier and no string of a specification is ever part of it. It runs with nothing but the names it is given.
"""
