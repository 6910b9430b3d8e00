"""Check compiled automata against the definitions of their logics, without any code of `rosmop/logics`."""
