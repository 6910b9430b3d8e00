"""Events as WebAssembly: code generation, the running instance, and the state that moves between the instance and
Python.
"""
