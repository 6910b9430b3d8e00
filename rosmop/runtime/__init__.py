"""Implement the functions that specifications call: arithmetic as in C++, strings, vectors, output, bounds.

They do no I/O: the time comes with each message, and output is returned as values. If a function can fault, its last
argument is the number of the *site* (a position in the specification).
"""
