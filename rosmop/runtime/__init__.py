"""Implement the functions that specifications call, without I/O: arithmetic as in C++, strings, vectors, output,
bounds.

If a function can fault, its last argument is the number of the *site* (a position in the specification).
"""
