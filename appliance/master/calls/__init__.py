"""The Master API: the path of a request, the table of calls, and the effect of each call."""
