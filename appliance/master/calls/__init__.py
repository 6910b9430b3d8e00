"""The Master API: the way of a request, the table of calls, and what each call does."""
