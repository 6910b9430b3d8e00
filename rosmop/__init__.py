"""The ``.rv`` language: specifications of monitors over the bytes of ROS messages.

`text` parses, `check` type-checks and lowers to the intermediate form in `form`, whose meaning the
interpreter in `run` defines, and `fast` translates parts of the form to WebAssembly. Only `recordings`,
`batch` and `tool` open files; monitors get the time from their caller.
"""
