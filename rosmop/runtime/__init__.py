"""What the functions of a specification call: arithmetic as in C++, strings, vectors, output, bounds.

Pure: time comes in with each message, and output goes out as values. Every function that can fault takes the
number of the *site* (a place in the text of the specification) as its last argument.
"""
