"""Answer the queries and orders of operators."""
