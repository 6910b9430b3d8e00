"""The functions that specifications call: arithmetic as in C++, strings, vectors, output, bounds.

They do no I/O: each message brings the time, and output is returned as values. The last argument of a function that
can fault is the number of the *site* (a position in the specification).
"""
