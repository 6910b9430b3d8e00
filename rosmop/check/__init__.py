"""Type-check specifications and lower them to the intermediate form (`form/nodes.py`).

Names in the form are generated (`v12`, `f3`), never identifiers of a specification.
"""
