"""From trees to functions: a specification is checked and written in the intermediate form (`ir/form.py`).

Names in the form are made here (`v12`, `f3`); no identifier of a specification is ever one.
"""
