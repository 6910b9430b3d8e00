"""The intermediate form of specifications, and what it means.

`form.py` is the form: what a checked specification is reduced to. `interpreter.py` says what it means, by doing it;
`functions.py` are the functions that it may call.
`module.py` writes what reads, calculates and patches as WebAssembly (`wasm.py` has the codes), and
`feed.py` the walk over the messages of a read around it.
"""
